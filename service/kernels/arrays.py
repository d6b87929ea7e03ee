"""Types of the arrays that kernels take: C-contiguous and, unless named Readonly, writable."""

from typing import Annotated

import numpy as np
import numpy.typing as npt

from service.compile.lazy import Layout

Float64_1D = Annotated[npt.NDArray[np.float64], Layout(np.float64, 1)]
Float64_2D = Annotated[npt.NDArray[np.float64], Layout(np.float64, 2)]
Float64_3D = Annotated[npt.NDArray[np.float64], Layout(np.float64, 3)]
Float32_1D = Annotated[npt.NDArray[np.float32], Layout(np.float32, 1)]
Float32_2D = Annotated[npt.NDArray[np.float32], Layout(np.float32, 2)]
Float32_3D = Annotated[npt.NDArray[np.float32], Layout(np.float32, 3)]
Float32_4D = Annotated[npt.NDArray[np.float32], Layout(np.float32, 4)]
Float32_5D = Annotated[npt.NDArray[np.float32], Layout(np.float32, 5)]
Int64_1D = Annotated[npt.NDArray[np.int64], Layout(np.int64, 1)]
Int32_1D = Annotated[npt.NDArray[np.int32], Layout(np.int32, 1)]
Int32_2D = Annotated[npt.NDArray[np.int32], Layout(np.int32, 2)]
Int32_3D = Annotated[npt.NDArray[np.int32], Layout(np.int32, 3)]
Int8_2D = Annotated[npt.NDArray[np.int8], Layout(np.int8, 2)]
Int8_3D = Annotated[npt.NDArray[np.int8], Layout(np.int8, 3)]
Int8_4D = Annotated[npt.NDArray[np.int8], Layout(np.int8, 4)]
UInt8_1D = Annotated[npt.NDArray[np.uint8], Layout(np.uint8, 1)]
UInt8_2D = Annotated[npt.NDArray[np.uint8], Layout(np.uint8, 2)]
UInt8_3D = Annotated[npt.NDArray[np.uint8], Layout(np.uint8, 3)]
UInt16_3D = Annotated[npt.NDArray[np.uint16], Layout(np.uint16, 3)]
UInt16_4D = Annotated[npt.NDArray[np.uint16], Layout(np.uint16, 4)]
Bool_1D = Annotated[npt.NDArray[np.bool_], Layout(np.bool_, 1)]
Bool_2D = Annotated[npt.NDArray[np.bool_], Layout(np.bool_, 2)]
ReadonlyFloat32_1D = Annotated[npt.NDArray[np.float32], Layout(np.float32, 1, is_readonly=True)]
# A kernel with this type is compiled twice: for maps of floats and of bytes.
LikelihoodCells = Annotated[
    npt.NDArray[np.float32] | npt.NDArray[np.uint8], Layout(np.float32, 3), Layout(np.uint8, 3)
]
