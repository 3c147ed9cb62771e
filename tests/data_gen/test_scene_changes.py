"""Objects of a released scene that are moved or removed."""

import numpy as np
import pytest

from data_gen.options import Options, make_job
from data_gen.scenes import get_scene
from data_gen.scenes.changes import changed
from wbgs_jax._util.errors import UserError


def bounds(spec, name):
    return next(part for part in spec.parts if part.name == name).mesh.bounds


def test_an_object_is_where_it_was_moved_to():
    before = get_scene(2)
    after = changed(before, ("coffee_table:0.3,-0.2,90",), ("lamp",))
    np.testing.assert_allclose(
        bounds(after, "coffee_table").mean(0), np.add(bounds(before, "coffee_table").mean(0), (0.3, -0.2, 0)), atol=1e-9
    )
    assert np.allclose(np.ptp(bounds(after, "coffee_table"), axis=0)[:2], np.ptp(bounds(before, "coffee_table"), axis=0)[1::-1])
    assert {part.name for part in before.parts} - {part.name for part in after.parts} == {"lamp"}
    np.testing.assert_array_equal(bounds(after, "sofa"), bounds(before, "sofa"))


@pytest.mark.parametrize(
    ("moved", "removed", "message"),
    [
        (("piano:1,0",), (), "'piano' is not an object of scene2"),
        ((), ("floor",), "'floor' is not an object of scene2"),
        (("lamp",), (), "'lamp' is not a movement"),
        (("lamp:one,0",), (), "'lamp:one,0' is not a movement"),
        (("sideboard:9,0",), (), "does not fit"),
        (("chair_1:0,0.3",), (), "does not fit where 'chair_1:0,0.3' moves it: table is in the way"),
    ],
)
def test_impossible_changes_are_refused(moved, removed, message):
    with pytest.raises(UserError, match=message):
        changed(get_scene(2), moved, removed)


def test_a_changed_scene_has_another_job_and_no_released_file(tmp_path):
    table = tmp_path / "tx.csv"
    table.write_text("x,y,z\n1,-1.5,1.2\n1,-1.8,1.2\n")
    options = Options(scene="2", removed=("lamp",), tx_grid=str(table), frequencies=(2.4,))
    job, usual = make_job(options), make_job(Options(scene="2", frequencies=(2.4,)))
    assert job.spec.mesh_sha256() != usual.spec.mesh_sha256() and len(job.tx_positions) == 2
    with pytest.raises(UserError, match="the released file must not be replaced"):
        options.default_out()
