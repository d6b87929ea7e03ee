import pytest

from drivers.registry import SENSOR_KINDS


def test_a_kind_is_made_once():
    assert SENSOR_KINDS["xsens_mtig"] is SENSOR_KINDS["xsens_mtig"]


def test_an_unknown_type_is_a_key_error():
    assert "nothing" not in SENSOR_KINDS
    assert SENSOR_KINDS.get("nothing") is None
    with pytest.raises(KeyError):
        SENSOR_KINDS["nothing"]


@pytest.mark.parametrize("name", list(SENSOR_KINDS))
def test_each_type_says_its_own_name(name: str):
    assert SENSOR_KINDS[name].config.model_fields["type"].default == name
