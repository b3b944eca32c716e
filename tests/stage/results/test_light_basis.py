"""The EXR and the JSON of coefficient images."""

import json

import numpy as np
import pytest

from stage.formats import exr
from stage.results.light_basis import facts_path, layer_types, numbers, write_facts, write_layers
from tests.scenes.captures import files_in


def test_layers_are_named_masked_and_of_their_type(tmp_path):
    rng, mask = np.random.default_rng(0), np.array([[True, False, True], [True, True, False]])
    layers = [rng.normal(size=(3, 2, 3)).astype(np.float16), rng.normal(size=(3, 2, 3)).astype(np.float32)]
    layers[1][:, ~mask] = np.nan
    write_layers(tmp_path / "b.exr", layers, mask, color_space="lin_ap1_scene", metadata={"relit:capture": "owl"})
    channels, metadata = exr.read(tmp_path / "b.exr")
    assert set(channels) == {f"basis.{k:03d}.{c}" for k in (0, 1) for c in "RGB"} | {"mask.Y"}
    for k, layer in enumerate(layers):
        for c, name in enumerate("RGB"):
            plane = channels[f"basis.{k:03d}.{name}"]
            assert plane.dtype == layer.dtype
            assert np.array_equal(plane[mask], layer[c][mask]) and not plane[~mask].any()
    assert np.array_equal(channels["mask.Y"], mask)
    assert metadata["colorInteropID"] == "lin_ap1_scene" and metadata["relit:capture"] == "owl"


@pytest.mark.parametrize(("rms", "largest", "wanted"), [
    ([1.0, 1.0, 1.0], 100.0, np.float16), ([1.0, 1.0, 1.0], 65505.0, np.float32), ([1e-5, 1e-4, 1e-5], 1.0, np.float32),
    ([0.0, 2.0**-11, 0.0], 1.0, np.float16)])
def test_a_layer_is_half_where_half_holds_it(rms, largest, wanted):
    assert layer_types(np.array([rms]), largest) == [wanted]


def test_facts_lie_beside_and_hold_floats_as_they_are(tmp_path):
    values = np.random.default_rng(1).normal(size=(2, 3)).astype(np.float32)
    path = write_facts(tmp_path / "b.ptm", {"kind": "ptm", "matrix": numbers(values), "one": numbers(values[0, 0])})
    assert path == facts_path(tmp_path / "b.ptm") == tmp_path / "b.ptm.json"
    facts = json.loads(path.read_text())
    assert facts["schema"] == "relit.basis/1" and facts["kind"] == "ptm"
    assert np.array_equal(np.array(facts["matrix"], dtype=np.float32), values) and np.float32(facts["one"]) == values[0, 0]
    assert files_in(tmp_path) == {"b.ptm.json"}
