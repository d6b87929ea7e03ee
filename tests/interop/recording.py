"""Readers of recordings: an independent CDR decoder, and a viewer's checker."""

from collections import Counter
from pathlib import Path

from service.encoding.outputs import decode_pose
from service.recording.mcap_reader import Recording
from tests.interop.programs import InteropError, Venv, run, run_client
from tests.interop.session import session

STATUS_OK = "ok"


def run_mcap_ros2(venv: Venv, folder: Path) -> str:
    """Values of each type are compared in tests/service, with rosbags; here every message is decoded."""
    drive = session(folder)
    messages = list(Recording([drive.mcap]).messages())
    stamps_ns = [decode_pose(m.payload).stamp_ns for m in messages if m.channel == "pose"]
    facts = {
        "mcap": str(drive.mcap),
        "counts": Counter(f"/{message.channel}" for message in messages),
        "stamps_ns": stamps_ns,
        "true_poses": [(pose.x_m, pose.y_m, pose.theta_rad) for pose in drive.true_poses(stamps_ns)],
    }
    seen = run_client(venv, "mcap_ros2_client.py", facts, folder)
    return (
        f"{seen['messages']} messages on {len(facts['counts'])} topics decoded, "
        f"poses {1000 * seen['rmse_m']:.1f} mm off the truth"
    )


def run_rerun(venv: Venv, folder: Path) -> str:
    drive = session(folder)
    home = folder / "rerun-home"
    home.mkdir(exist_ok=True)
    rerun = str(venv.bin / "rerun")
    run([rerun, "analytics", "disable"], home)
    table = run([rerun, "mcap", "check", "--full", str(drive.mcap)], home)
    rows = {cells[3]: cells for cells in map(str.split, table.splitlines()) if len(cells) >= 4}
    topics = [topic.name for topic in Recording([drive.mcap]).topics]
    bad = [topic for topic in topics if rows.get(topic, ("",))[0] != STATUS_OK]
    if bad:
        raise InteropError(f"rerun mcap check does not call {', '.join(bad)} ok:\n{table}")
    return f"mcap check --full calls all {len(topics)} topics ok"
