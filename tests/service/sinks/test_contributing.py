"""The output that CONTRIBUTING.md shows, as it stands there."""

import json
import re
import socket
import sys
from pathlib import Path
from textwrap import dedent
from types import ModuleType

import numpy as np
import pytest

from service.encoding import OK, WARNING, encode_pose
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, MapperOutput
from service.sinks.registry import SinkKind
from tests.service.sinks.contexts import sink_context

PAGE = Path(__file__).parents[3] / "CONTRIBUTING.md"


def pose():
    output = MapperOutput(
        5, SE2(1.0, 2.0, 0.0), SE2(), (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0
    )
    return encode_pose(output, 5)


def test_the_registry_line_opens_it_and_a_pose_comes_out(monkeypatch: pytest.MonkeyPatch):
    """The first Python block of the section is the module that the section calls it."""
    section = PAGE.read_text().partition("## Add an output\n")[2]
    block = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    module = ModuleType("service.sinks.udp_sink")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(dedent(block[1]), module.__dict__)
    line = re.search(r"^ +(SinkKind\(.*\)),$", PAGE.read_text(), re.MULTILINE)
    kind: SinkKind = eval(line[1])
    model = kind.load_model()
    assert kind.open_sink(model(), sink_context()) is None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(20.0)
        sink = kind.open_sink(model(host="127.0.0.1", port=receiver.getsockname()[1]), sink_context())
        sink.put(pose())
        assert json.loads(receiver.recv(1000)) == {"stamp_ns": 5, "x_m": 1.0, "y_m": 2.0}
        assert (sink.health().level, sink.health().values) == (OK, {"sent": "1"})
        sink.close()
        sink.put(pose())
        assert (sink.health().level, sink.health().message) == (WARNING, "1 dropped")
