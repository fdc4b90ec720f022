"""VTK PolyData in XML: points, triangles and vectors for ParaView and other programs."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shakercal._common.arrays import FloatArray, IntArray

XML = '<?xml version="1.0"?>\n<VTKFile type="{}" version="1.0"{}>'


def poly_data(
    positions_m: FloatArray, values: Mapping[str, NDArray[Any]], triangles: IntArray | None = None, vectors: str = ""
) -> str:
    """Return points (N, 3) with their values (N,) or (N, 3) as VTK PolyData.

    Doubles are in base64 after their length in bytes as UInt64 (VTK file formats, "XML file formats"). With `triangles`
    (T, 3) the points are corners, without they are single vertices. `vectors`: name of the main values.
    """
    count = len(positions_m)
    cells = np.arange(count)[:, None] if triangles is None else triangles
    kind = "Verts" if triangles is None else "Polys"
    chosen = f' Vectors="{escape(vectors)}"' if vectors else ""
    parts = [XML.format("PolyData", ' byte_order="LittleEndian" header_type="UInt64"'), "<PolyData>"]
    parts += [f'<Piece NumberOfPoints="{count}" NumberOf{kind}="{len(cells)}">', "<Points>"]
    parts += [_data_array("place_m", positions_m), "</Points>", f"<{kind}>"]
    parts += [_data_array("connectivity", cells.ravel())]
    parts += [_data_array("offsets", cells.shape[1] * np.arange(1, len(cells) + 1))]
    parts += [f"</{kind}>", f"<PointData{chosen}>"]
    parts += [_data_array(name, array) for name, array in values.items()]
    parts += ["</PointData>", "</Piece>", "</PolyData>", "</VTKFile>", ""]
    return "\n".join(parts)


def collection(files: Iterable[tuple[float, str]]) -> str:
    """Return the list (PVD) of files with their time or frequency."""
    steps = [f'<DataSet timestep="{at!r}" file="{escape(name)}"/>' for at, name in files]
    return "\n".join([XML.format("Collection", ""), "<Collection>", *steps, "</Collection>", "</VTKFile>", ""])


def _data_array(name: str, values: NDArray[Any]) -> str:
    """Return a DataArray of doubles, integers or bytes."""
    kind, dtype = {"f": ("Float64", "<f8"), "i": ("Int64", "<i8"), "u": ("UInt8", "u1")}[values.dtype.kind]
    raw = np.ascontiguousarray(values, dtype=dtype).tobytes()
    text = base64.b64encode(len(raw).to_bytes(8, "little") + raw).decode("ascii")
    components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    return f'<DataArray type="{kind}" Name="{name}"{components} format="binary">{text}</DataArray>'
