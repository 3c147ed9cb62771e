"""The input file of openEMS: a grid, materials as boxes, one source, and a probe at every point."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

from data_gen.full_wave.cabin import METAL
from data_gen.full_wave.model import MEDIA, PML_CELLS, Model
from data_gen.scenes.geometry import Vec3
from wbgs_jax._util.errors import UserError

CENTRE_HZ, HALF_BAND_HZ = 1.25e9, 0.5e9
"""Centre and half bandwidth of the Gaussian pulse, whose spectrum is 20 dB down half a band from the centre."""
OVERSAMPLING = 4
"""Number of samples stored relative to the minimum for the highest frequency of the pulse."""
PROBE = "point"
"""Prefix of the files of recorded voltages, followed by the point's number."""


def solver_input(model: Model, source: Vec3) -> str:
    """Returns the XML text of one run.

    The source is a vertical current two cells long, centred at `source`; at every point of the model the voltage over two cells
    is recorded. Centres are nodes, so that grids of several cell sizes have them at the same positions.

    Raises:
        UserError: a surface, the source or a point is not on a node.
    """
    corners = [c for block in model.blocks for c in (block.low, block.high)]
    places = [*corners, source, *(tuple(p) for p in model.points.tolist())]
    if (off := model.off_nodes(places)) > 1e-6:
        raise UserError(f"something is {off:.3f} cells off the nodes of the grid; cells of 10, 15 and 30 mm fit: --cell 0.015")
    root = Element("openEMS")
    fdtd = SubElement(
        root, "FDTD", NumberOfTimesteps=str(model.steps), endCriteria="0", f_max=_text(CENTRE_HZ + HALF_BAND_HZ),
        OverSampling=str(OVERSAMPLING),
    )  # fmt: skip
    SubElement(fdtd, "Excitation", Type="0", f0=_text(CENTRE_HZ), fc=_text(HALF_BAND_HZ))
    layer = f"PML_{PML_CELLS}"
    SubElement(fdtd, "BoundaryCond", xmin=layer, xmax=layer, ymin=layer, ymax=layer, zmin=layer, zmax=layer)
    structure = SubElement(root, "ContinuousStructure", CoordSystem="0")
    grid = SubElement(structure, "RectilinearGrid", DeltaUnit="1", CoordSystem="0")
    for name, axis in zip(("XLines", "YLines", "ZLines"), model.lines(), strict=True):
        SubElement(grid, name).text = ",".join(map(_text, axis))
    properties = SubElement(structure, "Properties")
    _add_blocks(properties, model)
    _add_source(properties, model, source)
    for i, point in enumerate(model.points.tolist()):
        probe = SubElement(properties, "ProbeBox", Name=f"{PROBE}{i}", Number="0", Type="0", Weight="1", NormDir="-1")
        _add_box(probe, 0, *_stick(tuple(point), model.cell))
    return ElementTree.tostring(root, encoding="unicode")


def _add_blocks(properties: Element, model: Model) -> None:
    """Writes every block as a box; later ones have higher priority."""
    for priority, block in enumerate(model.blocks, 1):
        name = f"{block.material}_{priority}"
        if block.material == METAL:
            owner = SubElement(properties, "Metal", Name=name)
        else:
            medium = MEDIA[block.material]
            owner = SubElement(properties, "Material", Name=name, Isotropy="1")
            SubElement(
                owner, "Property", Epsilon=_text(medium.permittivity), Mue="1", Kappa=_text(medium.conductivity()), Sigma="0"
            )
        _add_box(owner, priority, block.low, block.high)


def _add_source(properties: Element, model: Model, source: Vec3) -> None:
    owner = SubElement(properties, "Excitation", Name="source", Number="0", Enabled="1", Type="0", Excite="0,0,1")
    _add_box(owner, 0, *_stick(source, model.cell))


def _add_box(owner: Element, priority: int, low: Sequence[float], high: Sequence[float]) -> None:
    shape = SubElement(SubElement(owner, "Primitives"), "Box", Priority=str(priority))
    for name, corner in (("P1", low), ("P2", high)):
        SubElement(shape, name, {axis: _text(value) for axis, value in zip("XYZ", corner, strict=True)})


def _stick(middle: Sequence[float], cell: float) -> tuple[Vec3, Vec3]:
    """Returns the ends of a vertical line two cells long."""
    x, y, z = middle
    return (x, y, round(z - cell, 6)), (x, y, round(z + cell, 6))


def _text(value: float) -> str:
    """Returns a number as text with fixed precision: the solver compares surfaces and nodes exactly."""
    return f"{value:.10g}"
