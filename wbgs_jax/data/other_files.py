"""What files and folders of other programs are, and the way from there."""

from pathlib import Path

from wbgs_jax._util.errors import UserError

SNAPSHOTS = "read it with its own library and hand the arrays to `wb.scene_of_snapshots` (docs/formats.md)"
PATHS = "export its paths as DeepMIMO's converters do, or as the arrays of sionna.rt.Paths (docs/interchange.md)"
ROOM = "`wbgs-jax convert` makes a room of it beside measured data, data_gen makes spectra for it (docs/own_scene.md)"
MODELS = (".usd", ".usda", ".usdc", ".usdz", ".stl", ".dae", ".fbx", ".blend", ".3ds", ".off", ".3mf", ".abc", ".vtk", ".vtp")
KINDS = {
    ".h5": ("of HDF5", SNAPSHOTS),
    ".hdf5": ("of HDF5", SNAPSHOTS),
    ".parquet": ("of Parquet", PATHS),
    ".mat": (
        "of MATLAB",
        "give DeepMIMO's to `wbgs-jax convert --paths`, other arrays to `wb.scene_of_snapshots` (docs/formats.md)",
    ),
    ".npy": (
        "a single array of NumPy",
        "make a folder of images, or a scene file of snapshots, with places and receiver (docs/formats.md)",
    ),
    ".pkl": ("a pickle, which can run any program", "save its arrays as .npz"),
    ".pt": ("a pickle of PyTorch, which can run any program", "save its arrays as .npz"),
    ".p2m": ("of Wireless InSite", PATHS),
    ".uan": ("an antenna pattern of Wireless InSite", "patterns are named: tr38901, iso, dipole, hw_dipole (docs/formats.md)"),
    ".ffd": ("an antenna pattern of HFSS", "patterns are named: tr38901, iso, dipole, hw_dipole (docs/formats.md)"),
    ".csv": ("a table", "readings of powers go to `wbgs-jax measure --data FOLDER` (docs/measured.md)"),
    ".geojson": ("a map", "walls go into walls.csv (docs/measured.md)"),
    ".ifc": ("a building model", "export it as glTF or OBJ; then " + ROOM),
    ".dxf": ("a drawing", "export meshes as OBJ; then " + ROOM),
    ".svg": ("a drawing", "walls go into walls.csv (docs/measured.md)"),
    **dict.fromkeys((".xls", ".xlsx", ".ods"), ("a workbook", "save its sheets as .csv (docs/measured.md)")),
    **dict.fromkeys((".glb", ".gltf", ".obj", ".ply", ".xml"), ("a model of a room", ROOM)),
    **dict.fromkeys(MODELS, ("a model", "export it as glTF or OBJ; then " + ROOM)),
}
"""Of files by their suffix: what they are, and what to do with them."""
COLMAP = ("sparse", "cameras.bin", "cameras.txt", "transforms_train.json")
"""Of a folder of RF-3DGS: the cameras of its images."""


def check_kind(path: Path) -> None:
    """Raises a `UserError` for a file of another program, or a folder of another layout, that says what is missing."""
    kind = KINDS.get(path.suffix.lower())
    if path.is_file() and kind is not None:
        raise UserError(f"{path} is {kind[0]}, not a scene file; {kind[1]}")
    if not path.is_dir() or (path / "spectrum").exists():
        return
    if any((path / name).exists() for name in COLMAP):
        raise UserError(
            f"{path} is a folder of RF-3DGS: pictures by cameras of COLMAP, without the places of transmitters; give "
            "spectrum/, tx_pos.csv and gateway_info.yml (docs/formats.md)"
        )
    if any(path.glob("*.npy")):
        raise UserError(
            f"{path} holds arrays of NumPy; make a folder of images of them, spectrum/00001.png ..., with tx_pos.csv and "
            "gateway_info.yml, or a scene file of snapshots (docs/formats.md)"
        )
