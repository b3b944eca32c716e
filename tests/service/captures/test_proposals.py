"""Uploaded files that the service does not decode: videos."""

import pytest

from service.captures.importing import import_chosen, propose
from service.requests.base.import_choices import ImportChoices
from stage.errors import ManifestError


@pytest.mark.parametrize(("layout", "options"), [
    ("gray", {"projector": [64, 32]}), ("phase", {"projector": [64, 32], "periods": [8], "steps": 4})])
def test_a_video_is_left_to_the_machine_of_its_owner(tmp_path, layout, options):
    """The file is no video but for its name: whoever opened it would say so."""
    (tmp_path / "take.mp4").write_bytes(b"nothing")
    with pytest.raises(ManifestError, match=f"take.mp4: is a video: unpack it with relit import {layout} on your machine"):
        import_chosen(tmp_path, ImportChoices(layout=layout, file="take.mp4", options=options), (), "take")
    assert [path.name for path in tmp_path.iterdir()] == ["take.mp4"]


def test_a_video_is_not_proposed(tmp_path):
    (tmp_path / "take.mp4").write_bytes(b"nothing")
    with pytest.raises(ManifestError, match="relit import gray on your machine"):
        propose(tmp_path)
