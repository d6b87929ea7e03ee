"""Arrays as an .npz file that takes little time to write.

numpy's own writer packs four times as long for a tenth less on disk, and a map is stored each half minute.
"""

import zipfile
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

LEVEL = 1  # of zlib: tiles and points of 12 000 m2 pack in 20 ms a file, in 70 to 100 ms by level 6


def write_arrays(file: BinaryIO, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """To be read by numpy.load. Raises OSError."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as packed:
        for name, array in arrays.items():
            with packed.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
