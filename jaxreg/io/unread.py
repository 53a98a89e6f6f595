"""What is not read here: how to get at the points all the same."""

from collections.abc import Sequence
from pathlib import Path

_ELSEWHERE = {
    ".zip": "unpack it, and name the file inside",
    ".7z": "unpack it, and name the file inside",
    ".bin": "numpy.fromfile(path, numpy.float32).reshape(-1, 4)[:, :3] reads those of KITTI; save "
    "that with numpy.save to a .npy",
    ".gltf": "export it as .glb, which is one file",
    ".fbx": "export it as .glb, .obj or .ply, with Blender for instance",
    ".dae": "export it as .glb, .obj or .ply, with Blender for instance",
    ".3mf": "export it as .stl",
    ".step": "export the solid as .stl from the CAD program",
    ".iges": "export the solid as .stl from the CAD program",
    ".vtk": "save the data as .ply or .csv in ParaView",
    ".vtp": "save the data as .ply or .csv in ParaView",
    ".bag": "write one message to .pcd first, with pcl_ros bag_to_pcd for instance",
    ".mat": "scipy.io.loadmat reads it; save the array (n, 3) with numpy.save to a .npy",
    ".h5": "h5py reads it; save the array (n, 3) with numpy.save to a .npy",
    **dict.fromkeys(
        (".rcp", ".rcs", ".fls", ".fws", ".zfs", ".rxp", ".dp", ".lsproj"),
        "export it as .e57, .ptx or .las from the scanner's program",
    ),
}
_ELSEWHERE |= {".stp": _ELSEWHERE[".step"], ".igs": _ELSEWHERE[".iges"]}
_ELSEWHERE |= {".hdf5": _ELSEWHERE[".h5"], ".xz": _ELSEWHERE[".zip"], ".bz2": _ELSEWHERE[".zip"]}
_BEGINNINGS = {
    b"ply": ".ply", b"# .PCD": ".pcd", b"VERSION ": ".pcd", b"LASF": ".las", b"\x93NUMPY": ".npy",
    b"ASTM-E57": ".e57", b"glTF": ".glb", b"OFF": ".off", b"COFF": ".off", b"solid": ".stl",
}  # fmt: skip


def advice(path: Path, readable: Sequence[str]) -> str:
    """Why the suffix of `path` is not read, and what helps: by its name, or by how it begins."""
    name = path.with_suffix("").suffix if path.suffix.lower() == ".gz" else path.suffix
    told = f"{path}: unknown format '{name}'"
    if name.lower() in _ELSEWHERE:
        return f"{told}: {_ELSEWHERE[name.lower()]}."
    if seems := _seems(path):
        return f"{told}, but the file begins as '{seems}' does: give it that suffix."
    return f"{told}: convert the file to one of {', '.join(readable)}."


def _seems(path: Path) -> str:
    """The suffix that the first bytes speak for."""
    if not path.is_file() or path.suffix.lower() == ".gz":
        return ""
    with path.open("rb") as file:
        head = file.read(4096)
    for start, suffix in _BEGINNINGS.items():
        if head.startswith(start):
            return suffix
    words = head.rpartition(b"\n")[0].replace(b",", b" ").replace(b";", b" ").split()
    numbers = sum(word.lstrip(b"+-").replace(b".", b"", 1).isdigit() for word in words)
    return ".txt" if len(words) >= 3 and numbers > 0.7 * len(words) else ""
