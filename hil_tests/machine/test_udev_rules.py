"""The packaged udev rules, carried out by udev itself on made-up devices (umockdev).

`udevadm trigger`, which the pages name, sends the action "change"; plugging in sends "add".
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from hil_tests.waiting import NET_S

RULES = Path("configs/udev/60-mastctl.rules")
USB = "/devices/pci0000:00/usb1"
FTDI_PORT, FTDI_USB, CAMERA_USB = f"{USB}/1-2/1-2:1.0/ttyUSB0", f"{USB}/1-2", f"{USB}/1-3"
USB3_VISION = f"{USB}/1-4"
DEVICES = f"""
P: {FTDI_USB}
E: SUBSYSTEM=usb
E: DEVTYPE=usb_device
L: driver=../../../../bus/usb/drivers/usb
A: idVendor=0403
A: bDeviceClass=00
A: bDeviceSubClass=00
A: power/control=??

P: {FTDI_PORT}
E: SUBSYSTEM=usb-serial
L: driver=../../../../../../bus/usb-serial/drivers/ftdi_sio
A: latency_timer=9

P: {CAMERA_USB}
E: SUBSYSTEM=usb
E: DEVTYPE=usb_device
L: driver=../../../../bus/usb/drivers/usb
A: idVendor=046d
A: bDeviceClass=ef
A: bDeviceSubClass=02
A: power/control=??

P: {USB3_VISION}
E: SUBSYSTEM=usb
E: DEVTYPE=usb_device
E: DEVNAME=bus/usb/001/004
E: ID_USB_INTERFACES=:ef0500:ef0502:
A: bDeviceClass=ef
A: bDeviceSubClass=02
"""
"""Values are as long as those that are written: a made-up attribute is a file that udev does not shorten."""

APART = 'mount -t tmpfs none /run && mount --bind "$0" /etc/udev/rules.d && exec "$@"'
DEVICES_TRIED = (FTDI_PORT, FTDI_USB, CAMERA_USB, USB3_VISION)
SETTINGS = {
    f"{FTDI_PORT}/latency_timer": "1", f"{FTDI_USB}/power/control": "on", f"{CAMERA_USB}/power/control": "on",
}  # fmt: skip


def test_no_rule_waits_for_a_device_to_be_plugged_in_again(repository: Path) -> None:
    lines = (repository / RULES).read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    writes = [rule for rule in rules if re.search(r'ATTR\{[^}]+\}="', rule)]
    assert len(writes) == 3
    assert [rule for rule in rules if re.search(r'ACTION=="(add|bind)"', rule)] == []


@pytest.mark.parametrize("action", ["add", "change"])
def test_udev_sets_latency_and_power_at_plugging_and_at_a_trigger(
    repository: Path, tmp_path: Path, action: str
) -> None:
    missing = [name for name in ("umockdev-run", "udevadm", "unshare") if shutil.which(name) is None]
    if missing or os.geteuid() != 0:
        pytest.skip("needs root, and on Debian: apt-get install udev umockdev")
    rules, devices = tmp_path / "rules.d", tmp_path / "devices.umockdev"
    rules.mkdir()
    shown = (repository / RULES).read_text().replace('GROUP="video"', 'GROUP="video", ENV{SHOWN}="video"')
    (rules / RULES.name).write_text(shown)
    devices.write_text(DEVICES.lstrip())
    steps = [f"udevadm test --action={action} /sys{one} >&2" for one in DEVICES_TRIED]
    steps += [f"cat /sys{one}; echo" for one in SETTINGS]
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", APART, rules,
         "umockdev-run", "-d", devices, "--", "sh", "-c", "\n".join(steps)],
        capture_output=True, text=True, timeout=NET_S,
    )  # fmt: skip
    assert dict(zip(SETTINGS, done.stdout.split(), strict=True)) == SETTINGS, done.stderr
    of_usb3_vision = done.stderr.partition(f"DEVPATH={USB3_VISION}\n")[2]
    assert "SHOWN=video\n" in of_usb3_vision and done.stderr.count("SHOWN=video\n") == 1, done.stderr
