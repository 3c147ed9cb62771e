"""Files of kinds that are not read, by the programs that they belong to: refused by what they are, with the way from there."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from builders.conformance.entries import Entry, entries
from builders.conformance.shapes import CABINET, Geometry, geometry
from wbgs_jax.data import load_dataset


@dataclass
class Foreign:
    """What is handed to a training as data."""

    path: Path
    measure: str = "data"
    tolerance: float = 0.0

    def difference(self) -> float:
        """Returns infinity: what is read of it cannot be right."""
        load_dataset(self.path)
        return float("inf")


def drawing(name: str, draw: Callable[[Path], Any]) -> Callable[[Path], Geometry]:
    """Returns a maker of a file that is handed to the reader of rooms."""

    def make(folder: Path) -> Geometry:
        draw(folder / name)
        assert (folder / name).stat().st_size > 0
        return geometry(folder / name, {"cabinet": CABINET})

    return make


def data(name: str, write: Callable[[Path], Any]) -> Callable[[Path], Foreign]:
    """Returns a maker of a file or folder that is handed to the reader of data sets."""

    def make(folder: Path) -> Foreign:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write(folder / name)
        return Foreign(folder / name)

    return make


def refused(writer: str, form: str, varies: str, make: Callable[[Path], Any], needs: str = "", package: str = "") -> Entry:
    """Returns an entry that is to be refused."""
    (found,) = entries(writer, {(form, varies): (make, "refused")}, (needs,) if needs else (), package)
    return found


def stage(path: Path) -> None:
    """Writes a mesh with Pixar's library."""
    from pxr import Usd, UsdGeom, UsdUtils

    own = path.with_suffix(".usda") if path.suffix == ".usdz" else path
    made = Usd.Stage.CreateNew(str(own))
    mesh = UsdGeom.Mesh.Define(made, "/cabinet")
    mesh.CreatePointsAttr(CABINET.vertices.tolist())
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr(np.ravel(CABINET.polygons).tolist())
    made.Save()
    if own != path:
        UsdUtils.CreateNewUsdzPackage(str(own), str(path))


def plan_dxf(path: Path) -> None:
    """Writes walls as a drawing."""
    import ezdxf

    drawing = ezdxf.new()
    drawing.modelspace().add_lwpolyline([(0, 0), (6, 0), (6, 5), (0, 5)], close=True)
    drawing.saveas(path)


def house(path: Path) -> None:
    """Writes a wall as a building model."""
    import ifcopenshell

    model = ifcopenshell.file(schema="IFC4")
    model.create_entity("IfcWall", ifcopenshell.guid.new(), Name="wall")
    model.write(str(path))


def street(path: Path) -> None:
    """Writes an outline as a map."""
    import shapely

    path.write_text(shapely.to_geojson(shapely.box(0, 0, 6, 5)))


def plan_svg(path: Path) -> None:
    """Writes walls as a picture."""
    from matplotlib.figure import Figure

    figure = Figure()
    figure.add_subplot().plot([0, 6, 6, 0, 0], [0, 0, 5, 5, 0])
    figure.savefig(path)


def collada(path: Path) -> None:
    """Writes a box with pycollada."""
    from collada import Collada, geometry, source

    document = Collada()
    own = source.FloatSource("vertices", CABINET.vertices.ravel(), ("X", "Y", "Z"))
    made = geometry.Geometry(document, "cabinet", "cabinet", [own])
    inputs = source.InputList()
    inputs.addInput(0, "VERTEX", "#vertices")
    made.primitives.append(made.createTriangleSet(CABINET.triangles.ravel(), inputs, "grey"))
    document.geometries.append(made)
    document.write(str(path))


def hdf5(path: Path) -> None:
    """Writes channels as HDF5."""
    import h5py

    with h5py.File(path, "w") as stream:
        stream["snapshots"] = np.ones((6, 1, 1, 16), np.complex64)


def parquet(path: Path) -> None:
    """Writes paths as a table of columns."""
    import pyarrow
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table({"tau": [1e-8, 2e-8], "a": [0.1, 0.2]}), path)


def sheet(path: Path) -> None:
    """Writes readings as a workbook."""
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(["x", "y", "rssi_1"])
    book.save(path)


def colmap(path: Path) -> None:
    """Writes a folder as RF-3DGS has it: spectra beside cameras of COLMAP."""
    from PIL import Image

    (path / "sparse" / "0").mkdir(parents=True)
    (path / "images").mkdir()
    (path / "sparse" / "0" / "cameras.txt").write_text("1 PINHOLE 400 200 300 300 200 100\n")
    Image.fromarray(np.zeros((90, 360), np.uint8)).save(path / "images" / "00001.png")


def spectra(path: Path) -> None:
    """Writes a folder as GSpaRC has it: spectra as arrays."""
    path.mkdir()
    np.save(path / "spectra.npy", np.zeros((5, 90, 360), np.float32))


def matlab(path: Path) -> None:
    """Writes channels as MATLAB has them."""
    from scipy.io import savemat

    savemat(path, {"H": np.ones((6, 16), np.complex64)})


def lines(*text: str) -> Callable[[Path], Any]:
    """Returns what writes lines as Wireless InSite does."""
    return lambda path: path.write_text("\n".join(text) + "\n")


P2M = ("# <receiver> <x> <y> <z> <distance> <power> <phase>", "1 1.0 2.0 1.5 3.0 -61.2 12.0")
UAN = ("begin_<parameters>", "format free", "phi_min 0", "end_<parameters>", "0 0 -10 -10 0 0")
ENTRIES = [
    *(refused("OpenUSD", k, "a box", drawing(f"room.{k}", stage), "pxr", "usd-core") for k in ("usda", "usdc", "usdz")),
    refused("ezdxf", "dxf", "an outline", drawing("plan.dxf", plan_dxf), "ezdxf", "ezdxf"),
    refused("IfcOpenShell", "ifc", "a wall", drawing("house.ifc", house), "ifcopenshell", "ifcopenshell"),
    refused("Shapely", "geojson", "an outline", drawing("street.geojson", street), "shapely", "shapely"),
    refused("Matplotlib", "svg", "an outline", drawing("plan.svg", plan_svg), "matplotlib", "matplotlib"),
    refused("pycollada", "dae", "a box", drawing("room.dae", collada), "collada", "pycollada"),
    refused("Shapely", "geojson", "an outline, as data", data("map.geojson", street), "shapely", "shapely"),
    refused("OpenUSD", "usda", "a box, as data", data("room.usda", stage), "pxr", "usd-core"),
    refused("h5py", "h5", "channels", data("channels.h5", hdf5), "h5py", "h5py"),
    refused("h5py", "mat (7.3)", "channels", data("channels.mat", hdf5), "h5py", "h5py"),
    refused("PyArrow", "parquet", "paths", data("paths.parquet", parquet), "pyarrow", "pyarrow"),
    refused("openpyxl", "xlsx", "readings", data("readings.xlsx", sheet), "openpyxl", "openpyxl"),
    refused("SciPy", "mat", "channels", data("channels.mat", matlab), "scipy", "scipy"),
    refused("NumPy", "npy", "spectra", data("spectra.npy", lambda path: np.save(path, np.zeros(3))), "numpy", "numpy"),
    refused("NumPy", "folder of npy", "GSpaRC", data("gsparc", spectra), "numpy", "numpy"),
    refused("Pillow", "folder of COLMAP", "RF-3DGS", data("rf3dgs", colmap), "PIL", "pillow"),
    refused("wbgs-jax, as Wireless InSite", "p2m", "powers", data("a.power.t001_01.r002.p2m", lines(*P2M))),
    refused("wbgs-jax, as Wireless InSite", "uan", "an antenna", data("antenna.uan", lines(*UAN))),
]
