"""quell between a host and a drive that both stay as they are: three processes and two wires.

The drive is a twin that takes commands of speed, with a load that holds it back; its host is a
program of its own, with a P controller. ``quell proxy`` stands between them.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from quell.realtime import open_device

DT = 0.01
DRIVE = '{kind = "linear", num = [12.0], den = [1.0, 12.0, 0.5]}'  # a load pulls it back to zero
SETUP = f"""
dt = {DT}
[observer]
kind = "model-based"
omega_o = 30.0
plant = {{kind = "linear", num = [12.0], den = [1.0, 12.0, 0.0]}}
[controller]
kind = "compensator"
u_min = -3.0
u_max = 3.0
[rig]
device = "udp://127.0.0.1:5015"
"""


def started(*arguments: str) -> subprocess.Popen[str]:
    """Start a command of quell; return it when it listens."""
    command = [sys.executable, "-m", "quell", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    print(process.stdout.readline().strip())
    return process


def error_at(url: str) -> float:
    """Move to y = 1 with a P controller; return the error that is left after three seconds."""
    device = open_device(url, DT)
    y = 0.0
    for _ in range(300):
        y = device.read()
        device.write(2.0 * (1.0 - y))
    device.close()
    return 1.0 - y


with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "drive.toml"
    file.write_text(SETUP, encoding="utf-8")
    quick = ("--priority", "0")
    plant = ("--plant", DRIVE, "--dt", str(DT))
    drive = started("rig", "--device", "udp://127.0.0.1:5015", *plant, *quick)
    alone = error_at("udp://127.0.0.1:5015")
    proxy = started("proxy", str(file), "--host", "udp://127.0.0.1:5016", *quick)
    with_proxy = error_at("udp://127.0.0.1:5016")
    for process in (proxy, drive):
        process.terminate()
        process.wait(timeout=30)

print(f"error without the proxy {alone:.4f}, with it {with_proxy:.4f}")
assert abs(with_proxy) < 0.3 * abs(alone)
