"""The account of conformance: what is counted, and the lines of the table that rows belong to."""

import json

import pytest

from tools.qa.conformance import account, collect, kind_of, summary, table

ROW = {
    "writer": "Blender", "version": "5.0.1", "form": "glb", "varies": "a room", "expected": "right", "outcome": "right",
    "measure": "geometry", "difference": 1e-6, "approximate": False, "message": "",
}  # fmt: skip
ROUND = ROW | {"form": "xml", "writer": "Mitsuba 3", "difference": 4e-3, "approximate": True}
REFUSED = ROW | {"form": "stl", "outcome": "refused", "difference": None}
OURS = ROW | {"writer": "wbgs-jax, for DeepMIMO", "form": "folder", "measure": "channels", "difference": 2e-4}


def test_rows_are_counted(tmp_path):
    lines = [ROW, ROUND, REFUSED, OURS, {"writer": "Open3D"}, ROW | {"outcome": "different", "difference": float("inf")}]
    (tmp_path / "ledger.jsonl").write_text("\n".join(map(json.dumps, lines)))
    rows, missing = collect(tmp_path / "ledger.jsonl")
    assert missing == ["Open3D"] and rows[-1]["difference"] is None
    found = summary(rows)
    assert found["total"] == {"files": 5, "right": 3, "refused": 1, "different": 1, "writers": 2}
    assert found["kinds"]["deepmimo"]["largest_difference"] == 2e-4
    assert found["kinds"]["mitsuba"] == {"files": 1, "right": 1, "refused": 0, "different": 0, "writers": 1}
    assert found["measures"]["geometry"]["largest_difference"] == 1e-6
    assert found["versions"]["Blender"] == "5.0.1"
    assert "| Blender 5.0.1, glb | 2 | 1 | 0 | 1 | 1.0e-06 |" in table(rows)
    assert collect(tmp_path / "nothing") == ([], []) and account([])["files"] == 0


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({}, "gltf"),
        ({"form": "xml"}, "mitsuba"),
        ({"form": "dxf"}, "others"),
        ({"measure": "channels", "writer": "Sionna RT"}, "sionna"),
        ({"measure": "channels", "writer": "SciPy"}, "deepmimo"),
        ({"measure": "powers", "form": "csv"}, "readings"),
        ({"measure": "data", "form": "p2m"}, "others"),
    ],
)
def test_every_row_belongs_to_a_line(change, kind):
    assert kind_of(ROW | change) == kind
