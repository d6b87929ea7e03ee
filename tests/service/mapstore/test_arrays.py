import io

import numpy as np

from service.mapstore.arrays import write_arrays


def test_arrays_come_back_as_they_were_and_packed():
    arrays = {
        "zeros": np.zeros((300, 200)),
        "turned": np.arange(12, dtype=np.int16).reshape(3, 4)[::-1],
        "none": np.zeros((0, 2), np.float32),
        "names": np.array(["points_00000.npz"], np.str_),
    }
    file = io.BytesIO()
    write_arrays(file, arrays)
    assert len(file.getvalue()) < 10_000
    with np.load(io.BytesIO(file.getvalue()), allow_pickle=False) as back:
        assert back.files == list(arrays)
        for name, array in arrays.items():
            assert back[name].dtype == array.dtype
            np.testing.assert_array_equal(back[name], array)
