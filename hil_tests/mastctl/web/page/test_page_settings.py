"""The panel of camera settings: changed under the lease, and it follows changes of other clients."""

from __future__ import annotations

from collections.abc import Callable

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
