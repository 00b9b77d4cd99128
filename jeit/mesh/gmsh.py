"""Meshes made by Gmsh (optional: `pip install "jeit[mesh]"`), for geometries beyond jeit's own shapes."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import ModuleType

import numpy as np

from jeit.arguments.extras import optional
from jeit.mesh.files import read
from jeit.mesh.mesh import Mesh
from jeit.mesh.outline import Domain

CAD = (".step", ".stp", ".iges", ".igs", ".brep")
"""Files of geometry without cells, by the ends of their names."""
# Endings of files that Gmsh always reads as geometry; it takes all others for scripts.
_PLAIN = (*CAD, ".stl")


def from_gmsh(
    source: str | Path | Domain | None = None,
    *,
    cell_size: float | None = None,
    dimension: int | None = None,
    scale: float = 1.0,
    scripts: bool = False,
) -> Mesh:
    """Mesh a geometry with Gmsh.

    **Arguments**: `source`, a geometry file (.step, .iges, .brep, .stl), an outline such as `Disk`, or None for the
    model that is current in the `gmsh` module; `cell_size` in the geometry's own unit (metres for a domain), the
    largest edge; `dimension` 2 or 3 (by default the geometry's own): 2 of a solid is its surface, in space; `scale`,
    the geometry's unit in metres; `scripts`, whether `source` may be of Gmsh's own kind (.geo and all others), which
    can run any command and open any file: of your own only. Physical groups of the boundary become tags.

    Raises `ImportError` if the gmsh package or a system library it needs is missing, and `ValueError`
    if Gmsh refuses the geometry, and for scripts unless they are allowed.
    """
    if isinstance(source, (str, Path)) and not scripts and Path(source).suffix.lower() not in _PLAIN:
        raise ValueError(
            f"source: {Path(source).name[:80]} may be a script of Gmsh's, which can run any command. Give a file of "
            f"{', '.join(_PLAIN)}; or scripts=True, where it is your own."
        )
    gmsh = optional(
        "gmsh",
        "from_gmsh",
        "On Linux it needs libraries of the system too, such as libGLU. Discs, rectangles, polygons, layers, boxes and "
        "cylinders need no Gmsh: see jeit.mesh.",
    )
    if cell_size is not None and not (np.isfinite(cell_size) and cell_size > 0):
        raise ValueError(f"cell_size: expected a positive length, got {cell_size!r}.")
    if dimension not in (None, 2, 3):
        raise ValueError(f"dimension: expected 2 or 3, got {dimension!r}.")
    if isinstance(source, (str, Path)) and not Path(source).is_file():
        raise FileNotFoundError(f"source: there is no file {source}. Check the name and the working directory.")
    if source is None and not gmsh.isInitialized():
        raise ValueError(
            "source: Gmsh has no current model. Build one with the gmsh module, or give a file or outline."
        )
    own = not gmsh.isInitialized()
    if own:
        gmsh.initialize(interruptible=False)
    quiet = gmsh.option.getNumber("General.Terminal")
    gmsh.option.setNumber("General.Terminal", 0)
    name = str(source)
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mesh.msh"
            if isinstance(source, (str, Path)) and not scripts:
                # Beside it there may be options, which Gmsh opens with it, and they are a script.
                name = Path(source).name
                source = shutil.copy(str(source), Path(folder) / f"geometry{Path(source).suffix.lower()}")
            _write(gmsh, source, cell_size, dimension, path, name)
            return read(path, scale=scale)
    finally:
        gmsh.option.setNumber("General.Terminal", quiet)
        if own:
            gmsh.finalize()


def _write(
    gmsh: ModuleType,
    source: str | Path | Domain | None,
    cell_size: float | None,
    dimension: int | None,
    path: Path,
    name: str,
) -> None:
    """Write to `path`; messages call the geometry `name`."""
    try:
        if isinstance(source, (str, Path)):
            gmsh.open(str(source))
        elif source is not None:
            gmsh.model.add("jeit")
            _draw(gmsh, source)
        if cell_size is not None:
            gmsh.option.setNumber("Mesh.MeshSizeMax", cell_size)
        dimension = dimension or max(gmsh.model.getDimension(), 2)
        gmsh.model.mesh.generate(dimension)
        # As soon as there is one physical group, Gmsh leaves out all cells that are in none.
        grouped = {
            entity
            for group in gmsh.model.getPhysicalGroups(dimension)
            for entity in gmsh.model.getEntitiesForPhysicalGroup(*group)
        }
        rest = [entity for _, entity in gmsh.model.getEntities(dimension) if entity not in grouped]
        added = [(dimension, gmsh.model.addPhysicalGroup(dimension, rest))] if rest else []
        gmsh.option.setNumber("Mesh.MshFileVersion", 2.2)
        gmsh.write(str(path))
        if added:
            gmsh.model.removePhysicalGroups(added)
    except Exception as error:
        said = str(error).replace(str(source), name[:40]).rstrip(".")[:80]
        raise ValueError(f"source: Gmsh could not mesh the geometry: {said}.") from error


class _Kernel:
    """Gmsh's geometry kernel as a pen: a curve loop for each stroke."""

    def __init__(self, gmsh: ModuleType):
        self.shape = gmsh.model.occ
        self.loops: list[int] = []

    def circle(self, centre: tuple[float, float], radius: float) -> None:
        self.loops.append(self.shape.addCurveLoop([self.shape.addCircle(*centre, 0.0, radius)]))

    def loop(self, vertices: np.ndarray) -> None:
        corners = [self.shape.addPoint(float(x), float(y), 0.0) for x, y in vertices]
        sides = [self.shape.addLine(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
        self.loops.append(self.shape.addCurveLoop(sides))


def _draw(gmsh: ModuleType, domain: Domain) -> None:
    if not isinstance(domain, Domain):
        raise ValueError(f"source: expected a file, an outline or None, got {type(domain).__name__}")
    kernel = _Kernel(gmsh)
    domain.draw(kernel)
    kernel.shape.addPlaneSurface(kernel.loops)
    kernel.shape.synchronize()
