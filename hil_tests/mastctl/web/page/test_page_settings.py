"""The panel of camera settings: changed under the lease, and it follows changes of other clients."""

from __future__ import annotations

from collections.abc import Callable

from drivers.interfaces import CameraSetting
from hil_tests.mastctl.devices.test_camera_settings import SetCamera
from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.mastctl.web.page.conftest import Visit
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.daemon import RunningDaemon


def test_the_panel_shows_bounds_and_changes_a_setting_under_the_lease(
    pair: tuple[RunningDaemon, FakeHardware], visit: Callable[..., Visit]
) -> None:
    daemon, _ = pair
    left = SetCamera("navcam_left")
    daemon.service.devices._cameras._cameras["navcam_left"] = left
    page = visit(daemon.url).page
    panel = page.locator("#settings")
    panel.get_by_role("combobox").select_option("navcam_left")
    gain = panel.get_by_label("Gain of navcam left")
    gain.wait_for()
    assert gain.input_value() == "8" and gain.is_disabled()
    assert "0 to 100" in panel.inner_text() and "Take control to change them." in panel.inner_text()
    page.get_by_role("button", name="Take", exact=True).click()
    until(lambda: gain.is_enabled(), "the lease")
    gain.fill("20")
    panel.get_by_role("button", name="Set").click()
    until(lambda: left.sets == [{"gain": 20.0}], "the change")
    until(lambda: gain.input_value() == "20", "what came of it")
    gain.fill("200")
    panel.get_by_role("button", name="Set").click()
    assert left.sets == [{"gain": 20.0}], "the browser keeps to the bounds"
    page.get_by_role("button", name="Release", exact=True).click()
    with Client(daemon.url, name="other") as other:
        other.set_camera("navcam_left", gain=40)
    until(lambda: gain.input_value() == "40", "the change of another client")


def test_the_fields_of_one_camera_never_stand_beside_the_name_of_another(
    pair: tuple[RunningDaemon, FakeHardware], visit: Callable[..., Visit]
) -> None:
    """The other one does not answer, and the first would be set by its name."""
    daemon, _ = pair
    left, right = SetCamera("navcam_left"), SetCamera("navcam_right")
    daemon.service.devices._cameras._cameras |= {"navcam_left": left, "navcam_right": right}
    right.told = CameraSetting("iris", 1.0, 0.0, 2.0)  # which is refused
    page = visit(daemon.url).page
    panel = page.locator("#settings")
    page.get_by_role("button", name="Take", exact=True).click()
    panel.get_by_role("combobox").select_option("navcam_left")
    gain = panel.get_by_label("Gain of navcam left")
    until(lambda: gain.is_enabled(), "the lease")
    panel.get_by_role("combobox").select_option("navcam_right")
    until(lambda: "iris" in panel.inner_text(), "why it has no settings")
    assert gain.count() == 0
    assert panel.get_by_role("button", name="Set").is_disabled()
    panel.get_by_role("combobox").select_option("navcam_left")
    until(lambda: gain.is_enabled(), "its fields")
    assert "iris" not in panel.inner_text()
