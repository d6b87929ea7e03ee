"""Lasers of one protocol by their own names: taken, refused with the setting to write, or not read at all."""

from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DeviceError
from drivers.hokuyo_utm30lx import models as hokuyo
from drivers.hokuyo_utm30lx.advice import ADVICE as HOKUYO_ADVICE
from drivers.sick_lms100 import models as sick
from drivers.sick_lms100.advice import ADVICE as SICK_ADVICE
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.sick_setup import Lms100Setup
from tests.drivers import lms100, utm30lx

PAGES = Path(__file__).parents[2] / "docs/devices"
OEM = "something of an OEM"
SICK = [("LMS111", "lms1xx"), ("LMS10x_FieldEval", "lms1xx"), ("LMS511_FieldEval", "lms5xx"),
        ("TiM571", "tim5xx"), ("TiM781S", "tim7xx")]  # fmt: skip
HOKUYO = [("SOKUIKI Sensor TOP-URG UTM-30LX", "utm_30lx"), ("UTM-30LX-EW", "utm_30lx"), ("UST-10LX", "ust"),
          ("UST-20LX", "ust"), ("SOKUIKI Sensor URG-04LX-UG01(Simple-URG)", "urg_04lx_ug01")]  # fmt: skip


@pytest.mark.parametrize(("name", "model"), SICK)
def test_sick_scanner_is_of_the_family_that_its_name_says(name: str, model: str):
    assert sick.model_of(name) == model
    assert sick.mismatch(name, model) == sick.mismatch(OEM, model) == ""
    assert SICK_ADVICE.settings_of({"device": name}) == {"model": model}
    assert SICK_ADVICE.settings_of({"device": OEM}) == {}
    assert SICK_ADVICE.doubt(lms100.config(model=model), {"device": name}) == ""
    for other in sick.MODELS.keys() - {model}:
        expected = f"expected {sick.MODELS[other].name}"
        assert expected in SICK_ADVICE.doubt(lms100.config(model=other), {"device": name})
        assert sick.mismatch(name, other) == (
            f"this is of the family {sick.MODELS[model].name} (it calls itself {name}), {expected}; "
            f"write model: {model}"
        )


@pytest.mark.parametrize(("name", "model"), HOKUYO)
def test_hokuyo_laser_is_of_the_model_that_its_name_says(name: str, model: str):
    assert hokuyo.model_of(name) == model
    assert hokuyo.mismatch(name, model) == ""
    assert HOKUYO_ADVICE.settings_of({"product": name}) == {"model": model}
    assert HOKUYO_ADVICE.settings_of({"product": OEM}) == {}
    for other in hokuyo.MODELS.keys() - {model}:
        assert hokuyo.mismatch(name, other) == (
            f"this is a {name}, expected a {hokuyo.MODELS[other].name}; write model: {model}"
        )


def test_name_of_an_oem_is_taken():
    assert utm30lx.talk(Utm30lxSetup(product=OEM)).run(3.0).session.status == "streaming"


UST = Utm30lxSetup(wire="ethernet", model="ust")


@pytest.mark.parametrize(
    ("bench", "setup", "changes", "words"),
    [
        *(
            (lms100, Lms100Setup(model=model), {}, f"expected LMS1xx; write model: {model}; is host")
            for model in ("lms5xx", "tim5xx", "tim7xx")
        ),
        (utm30lx, UST, {"host": "192.168.0.10"}, r"write model: ust; is \S+ the right laser\?"),
        (utm30lx, Utm30lxSetup(model="urg_04lx_ug01"), {}, r"write model: urg_04lx_ug01; is \S+ the right"),
        (utm30lx, Utm30lxSetup(), {"model": "urg_04lx_ug01"}, r"write model: utm_30lx; is \S+ the right"),
        *(
            (lms100, Lms100Setup(ident=ident, measuring=False), {}, f"family {family} .* which is not read")
            for ident, family in (("MRS1xxxx", "MRS1000"), ("LMS1xxxx", "LMS1000"), ("LMS4111R", "LMS4000"))
        ),
        *(
            (utm30lx, Utm30lxSetup(product=name), {}, f"this is a {name}.* not read: that would need ")
            for name in ("SOKUIKI Sensor TOP-URG UTM-X002S", "UXM-30LX-EW", "UAM-05LP", "UGM-50LXP")
        ),
    ],
)
def test_another_model_is_refused_with_what_to_write_and_left_alone(
    bench: Any, setup: Any, changes: dict[str, Any], words: str
):
    t = bench.talk(setup, **changes)
    with pytest.raises(DeviceError, match=words):
        t.run(5.0)
    assert not any(command in t.sent for command in (b"sWN", b"sMN", b"MD", b"BM"))


@pytest.mark.parametrize("name", sick.MODELS)
def test_page_states_the_range_of_each_sick_family(name: str):
    assert f"| {sick.MODELS[name].range_max_m:g} |" in row_of("sick_lms100.md", name)


@pytest.mark.parametrize("name", hokuyo.MODELS)
def test_page_states_rate_and_ranges_of_each_hokuyo_model(name: str):
    model = hokuyo.MODELS[name]
    figures = f"| {model.rate_hz:g} | {model.range_min_m:g}, {model.range_max_m:g} |"
    assert figures in row_of("hokuyo_utm30lx.md", name)


def row_of(page: str, name: str) -> str:
    [row] = [line for line in (PAGES / page).read_text().splitlines() if line.startswith(f"| `{name}` |")]
    return row
