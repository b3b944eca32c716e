"""docs/service_storage.md: the layout that it promises is the one that there is."""

import os
from pathlib import Path

from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, JOB, new_id
from service.server.base.settings import Settings
from service.server.jobs.one_step import KEYS_FILE
from service.server.storage import layout, objects, scratch
from service.server.storage.objects import SCRATCH
from service.server.storage.part_files import part_files_folder

TEXT = (Path(__file__).parents[4] / "docs" / "service_storage.md").read_text(encoding="utf-8")


def test_every_name_is_in_the_docs(tmp_path):
    settings = Settings(data=tmp_path)
    for kind in (CAPTURE, ENVIRONMENT):
        assert f"{os.path.dirname(layout.intake('PROJECT', new_id(kind)))}/ID/…" in TEXT and f"`{kind}_…`" in TEXT
    assert f"{os.path.dirname(layout.results('PROJECT', new_id(JOB)))}/ID/…" in TEXT
    for name in (*layout.SOLVED, layout.FRAMES.replace("####", "0001"), layout.PICTURE, f"{layout.ASSET}.usdz", KEYS_FILE,
                 f"{part_files_folder(settings).name}/", f"{settings.cache.name}/", f"{SCRATCH}/", f"{objects.REMOVED}/",
                 objects.PROBE, "storage_url", "scratch_bytes", "chunk_frames", "database_url"):
        assert name in TEXT, name
    assert {"storage_url", "scratch_bytes", "chunk_frames", "database_url"} <= Settings.model_fields.keys()
    assert scratch.IN_USE_S == 6 * 3600 and "the last six hours" in TEXT
