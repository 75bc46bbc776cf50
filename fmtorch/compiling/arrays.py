"""Types of a kernel's arguments, by which it is compiled: ``F8x2`` is an array of float64 with two axes in C order."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
F8x1: TypeAlias = Annotated[NDArray[np.float64], "f8[::1]"]
F8x2: TypeAlias = Annotated[NDArray[np.float64], "f8[:, ::1]"]
F8x3: TypeAlias = Annotated[NDArray[np.float64], "f8[:, :, ::1]"]
F8x4: TypeAlias = Annotated[NDArray[np.float64], "f8[:, :, :, ::1]"]
F4x1: TypeAlias = Annotated[NDArray[np.float32], "f4[::1]"]
F4x2: TypeAlias = Annotated[NDArray[np.float32], "f4[:, ::1]"]
F4x3: TypeAlias = Annotated[NDArray[np.float32], "f4[:, :, ::1]"]
I1x2: TypeAlias = Annotated[NDArray[np.int8], "i1[:, ::1]"]
I8x1: TypeAlias = Annotated[NDArray[np.int64], "i8[::1]"]
I8x2: TypeAlias = Annotated[NDArray[np.int64], "i8[:, ::1]"]
I4x1: TypeAlias = Annotated[NDArray[np.int32], "i4[::1]"]
I4x2: TypeAlias = Annotated[NDArray[np.int32], "i4[:, ::1]"]
U1x1: TypeAlias = Annotated[NDArray[np.uint8], "u1[::1]"]
B1x1: TypeAlias = Annotated[NDArray[np.bool_], "b1[::1]"]
B1x2: TypeAlias = Annotated[NDArray[np.bool_], "b1[:, ::1]"]
