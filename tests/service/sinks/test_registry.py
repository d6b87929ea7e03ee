import subprocess
import sys


def test_to_read_a_config_imports_no_network_and_no_recorder():
    program = (
        "import sys; from service.config import parse_config; "
        "parse_config('vehicle: v\\nsensors: {f: {type: sick_lms100, host: h}}\\n"
        "recording: {directory: r}\\nmap: {directory: m}\\n', 'c'); "
        "print([name for name in ('zenoh', 'mcap') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
