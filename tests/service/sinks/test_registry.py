import subprocess
import sys

from service.sinks.registry import SINKS


def test_every_kind_has_its_model_and_its_opener():
    for kind in SINKS:
        assert kind.load_model().model_config["extra"] == "forbid"
        module, _, name = kind.opener.partition(":")
        assert callable(getattr(__import__(module, fromlist=[name]), name))
    assert len({kind.opener for kind in SINKS}) == len(SINKS)
    models = {(kind.section, kind.model) for kind in SINKS}
    assert len({section for section, _ in models}) == len(models)  # sinks of one section share its model


def test_to_read_a_config_imports_no_network_and_no_recorder():
    program = (
        "import sys; from service.config import parse_config; "
        "parse_config('vehicle: v\\nsensors: {f: {type: sick_lms100, host: h}}\\n"
        "recording: {directory: r}\\nmap: {directory: m}\\n', 'c'); "
        "print([name for name in ('zenoh', 'mcap') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
