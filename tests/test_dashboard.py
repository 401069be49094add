"""The dashboard in a real browser: headless Chromium, driven by Playwright."""

from __future__ import annotations

import contextlib
import http.server
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe

from pea import load
from pea_drivers.emulator import Control
from pea_experiment import experiments
from pea_record.bag import BagWriter
from pea_record.origin import ORIGIN, origin
from pea_record.rows import ahead, record

CHROMIUM = shutil.which("chromium")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright from PyPI")

pytestmark = [
    pytest.mark.alone,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium: apt install chromium"),
    pytest.mark.timeout(240),
]

PATIENCE = 90.0
expect = playwright.expect
expect.set_options(timeout=PATIENCE * 1e3)
FOREIGN = "elsewhere.example"
"""A name of another machine's, which leads to this one: as a page that bends names has it."""

FLAGS = (
    f"--host-resolver-rules=MAP {FOREIGN} 127.0.0.1",
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
)
EXPERIMENT = "fig9_hysteresis_10hz"
DROPPED = (
    *("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"),
    "PYTEST_CURRENT_TEST",  # NiceGUI goes by it
)
GAINS = ("--set", "controller.preset=paper_set1", "--set", "plant.sensor.ideal=false")
LOOSE = ("stale_samples", "stuck_samples", "following_samples")
SCANNER = "e727_xy_emulated"
OBSERVED = ("--set", "observer.type=extended_state")


class Dashboard:
    """A `pea dashboard` that runs."""

    def __init__(self, there: Path, *arguments: str, **environment: str) -> None:
        with socket.socket() as a, socket.socket() as b:
            a.bind(("127.0.0.1", 0))
            self.port = a.getsockname()[1]
            with contextlib.suppress(OSError):
                b.bind(("127.0.0.1", self.port + 1))
        self.there = there
        self.log = there / "dashboard.txt"
        clean = {name: value for name, value in os.environ.items() if name not in DROPPED}
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "pea_cli.cli", "dashboard"),
                    *("--port", str(self.port), *arguments),
                ],
                cwd=there,
                env={**clean, "PYTHONUNBUFFERED": "1", **environment},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def said(self) -> str:
        return self.log.read_text(errors="replace")

    def end(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(PATIENCE)

    def close(self) -> None:
        for process in [*self.runs(), *self.runs(b"report")]:
            os.kill(process, signal.SIGINT)
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def runs(self, command: bytes = b"run") -> list[int]:
        """Process ids of the runs in its directory, or of another command."""
        found = []
        for there in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                words = (there / "cmdline").read_bytes().split(b"\0")
                ours = b"pea_cli.cli" in words and command in words
                if ours and os.readlink(there / "cwd") == str(self.there):
                    found.append(int(there.name))
        return found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def dashboard(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dashboard]:
    there = tmp_path_factory.mktemp("dashboard").resolve()
    odd = os.fsencode(there / "runs") + b"/odd\xff\x1b[31m"
    os.makedirs(odd)
    open(odd + b"/a.mcap", "wb").close()  # no recording: the page shows it nonetheless
    started = Dashboard(there, "--run", EXPERIMENT, "--duration", "600", *GAINS, *OBSERVED)
    yield started
    started.close()


def opened(browser: Any, dashboard: Dashboard, width: int = 1440, height: int = 900) -> Any:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(PATIENCE * 1e3)
    page.complaints = []
    page.requests = []
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.on("request", lambda request: page.requests.append(request.url))
    until_served(dashboard)
    page.goto(dashboard.address)
    return page


def until(true: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """Wait for a condition; give what it says at last."""
    end = time.monotonic() + patience
    while not (found := true()) and time.monotonic() < end:
        time.sleep(0.05)
    return found


def until_served(dashboard: Dashboard) -> None:
    def served() -> bool:
        with contextlib.suppress(OSError):
            return bool(urllib.request.urlopen(dashboard.address, timeout=5).status == 200)
        return dashboard.process.poll() is not None

    assert until(served)
    assert dashboard.process.poll() is None, dashboard.said()


def read(address: str) -> str:
    with urllib.request.urlopen(address, timeout=30) as answer:
        return answer.read().decode()


def rms(page: Any) -> float:
    return page.evaluate("peaScope.frame.rms_nm") or 0.0


def picture(page: Any, name: str) -> None:
    """Keep a picture for the documentation, where that is asked for."""
    folder = os.environ.get("PEA_SCREENSHOTS")
    if folder:
        page.screenshot(path=Path(folder) / f"{name}.png")


@pytest.fixture(scope="module")
def page(browser: Any, dashboard: Dashboard) -> Iterator[Any]:
    page = opened(browser, dashboard)
    page.wait_for_function("window.peaScope && peaScope.frame.rms_nm > 0")
    yield page
    page.close()


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[int]:
    """Port of another server on this machine, with a page of no words."""

    class Empty(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!DOCTYPE html><title>elsewhere</title>")

        def log_message(self, format: str, *arguments: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Empty) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_address[1]
        server.shutdown()


ATTACK = """async ([page, stop]) => {
  const seen = {};
  const body = 'x'.repeat(1024) + `POST /stop HTTP/1.1\\r\\nHost: ${new URL(stop).host}\\r\\n`
    + 'Content-Length: 0\\r\\n\\r\\n';
  const settled = (made) => new Promise((done) => {
    made.onload = () => done('loaded');
    made.onerror = () => done('refused');
    document.body.append(made);
  });
  const at = (tag, url) => settled(Object.assign(document.createElement(tag), { src: url }));
  const framed = async (url, method) => {
    const frame = document.createElement('iframe');
    frame.name = `f${Math.random()}`;
    const loaded = settled(frame);
    await loaded;
    const form = Object.assign(document.createElement('form'),
      { action: url, method, target: frame.name, enctype: 'text/plain' });
    form.append(Object.assign(document.createElement('textarea'), { name: 'a', value: body }));
    document.body.append(form);
    const again = new Promise((done) => { frame.onload = () => done(); });
    form.submit();
    await again;
    try { return frame.contentDocument ? 'read' : 'opaque'; } catch { return 'opaque'; }
  };
  const socket = (url) => new Promise((done) => {
    const made = new WebSocket(url.replace('http', 'ws'));
    made.onopen = () => done('opened');
    made.onerror = () => done('refused');
  });
  for (const [name, root] of [['page', page], ['stop', stop]]) {
    for (const path of ['', 'stop', 'live', 'pea-static/scope.js']) {
      seen[`${name} fetch ${path}`] = await fetch(root + path,
        { method: 'POST', mode: 'no-cors', credentials: 'include', body })
        .then((answer) => answer.type, () => 'refused');
      seen[`${name} read ${path}`] = await fetch(root + path)
        .then(() => 'read', () => 'refused');
      seen[`${name} image ${path}`] = await at('img', root + path);
      seen[`${name} script ${path}`] = await at('script', root + path);
    }
    seen[`${name} form`] = await framed(root + 'stop', 'POST');
    seen[`${name} frame`] = await framed(root, 'GET');
    for (const path of ['live', '_nicegui_ws/socket.io/?EIO=4&transport=websocket', 'stop']) {
      seen[`${name} socket ${path}`] = await socket(root + path);
    }
  }
  return seen;
}"""


@pytest.mark.parametrize("host", ["127.0.0.1", FOREIGN], ids=["port", "name"])
def test_another_page_cannot_stop_or_change_or_read_anything(
    page, browser, dashboard, elsewhere, host
):
    expect(page.locator(".at-state")).to_have_text("running")
    runs, stop = dashboard.runs(), f"http://127.0.0.1:{dashboard.port + 1}/"
    other = browser.new_page()
    other.goto(f"http://{host}:{elsewhere}/")
    seen = other.evaluate(ATTACK, [dashboard.address, stop])
    assert not {name: what for name, what in seen.items() if what not in ("refused", "opaque")}
    for port in (dashboard.port, dashboard.port + 1):  # a name that leads here
        answer = other.goto(f"http://{FOREIGN}:{port}/")
        assert (answer.status, "pea-stop" in answer.text()) == (403, False)
    other.close()
    before = page.evaluate("peaScope.frame.last")
    page.wait_for_function("t => peaScope.frame.last > t + 0.2", arg=before)
    assert dashboard.runs() == runs
    expect(page.locator("#pea-stopped")).to_be_hidden()


def test_the_curve_moves_and_nothing_comes_from_elsewhere(page, dashboard):
    expect(page.locator(".at-state")).to_have_text("running")
    before = page.evaluate("[peaFrames.drawn, peaScope.frame.last]")
    page.wait_for_function(
        "([n, t]) => peaFrames.drawn > n + 20 && peaScope.frame.last > t + 0.5", arg=before
    )
    y = page.evaluate("Array.from(peaScope.frame.arrays.y)")
    assert max(y) - min(y) == pytest.approx(10.0, abs=1.5)
    page.wait_for_function("Array.from(peaScope.frame.arrays.eps).some(Number.isFinite)")
    assert all(url.startswith(dashboard.address) for url in page.requests)
    assert page.complaints == []


def test_a_gain_is_judged_before_it_is_applied_and_the_error_falls(page, browser, dashboard):
    before = rms(page)
    entry = page.get_by_label("controller I", exact=True)
    expect(entry).to_have_value("0.06")
    other = opened(browser, dashboard, 1000, 800)
    entry.fill("1000")
    entry.press("Enter")
    expect(page.locator(".at-verdict")).to_have_text(re.compile("will be refused: gain margin 0"))
    page.get_by_role("button", name="Apply").click()
    refusal = page.locator(".q-notification").filter(
        has_text="/pea/controller refuses: gain margin"
    )
    expect(refusal).to_be_visible()
    refusal.get_by_role("button", name="Close").click()
    entry.fill("1")
    entry.press("Enter")
    expect(page.locator(".at-verdict")).to_have_text(re.compile(r"gain margin \d"))
    expect(other.get_by_label("controller I", exact=True)).to_have_value("1")
    assert rms(page) > 0.9 * before  # not applied yet
    page.get_by_role("button", name="Apply").click()
    page.wait_for_function("before => peaScope.frame.rms_nm < 0.5 * before", arg=before)
    other.wait_for_function("before => peaScope.frame.rms_nm < 0.5 * before", arg=before)
    expect(other.locator(".at-state")).to_have_text("running")
    other.close()
    picture(page, "dashboard")
    page.get_by_role("button", name="Undo").click()
    page.wait_for_function("before => peaScope.frame.rms_nm > 0.9 * before", arg=before)
    expect(entry).to_have_value("0.06")


def test_density_and_response_are_chosen_and_read_out(page):
    choice = page.get_by_label("what is shown over frequency")
    for kind, name, line in (
        ("density", "Noise density in nm/√Hz", "density"),
        ("response", "Response in 1", "T"),
        ("amplitude", "Error spectrum in nm", "amplitude"),
    ):
        choice.select_option(kind)
        page.wait_for_function("line => peaScope.frame.arrays[line]?.length > 0", arg=line)
        expect(page.get_by_role("img", name=name, exact=True)).to_be_visible()
    pause = page.locator("[data-act=pause]")
    expect(pause).to_have_attribute("aria-pressed", "false")
    pause.press("Enter")
    expect(pause).to_have_attribute("aria-pressed", "true")
    expect(pause).to_be_focused()
    pause.press("Enter")


def test_pause_holds_the_picture_and_the_window_is_chosen(page):
    page.wait_for_function("peaScope.frame.last > 0")  # before the first sample nothing is to hold
    page.locator("[data-act=pause]").click()
    page.wait_for_function(  # what was on its way is over
        "Math.abs(peaScope.frame.t0 + peaScope.frame.span - peaScope.view.end) < 1e-3"
        " && peaScope.view.end + 0.03 < peaScope.frame.last"
    )
    held = page.evaluate("peaScope.frame.t0")
    page.wait_for_function("peaScope.view.end + 0.3 < peaScope.frame.last")
    assert page.evaluate("peaScope.frame.t0") == pytest.approx(held, abs=1e-3)
    page.get_by_label("width of the window").select_option("0.1")
    page.wait_for_function("peaScope.frame.span === 0.1")
    page.locator("[data-act=pause]").click()
    page.wait_for_function("peaScope.frame.t0 + peaScope.frame.span > peaScope.frame.last - 0.01")
    said = page.evaluate(  # as before the first sample
        "() => { peaScope.frame = { arrays: {}, span: 1 };"
        " peaScope.pauseButton.click();"
        " return [peaScope.querySelector('nav [role=status]').textContent, peaScope.view.end]; }"
    )
    assert said == ["no samples yet: nothing to pause", None]
    page.wait_for_function("peaScope.querySelector('nav [role=status]').textContent === ''")


@pytest.mark.parametrize("width", [800, 390])
def test_in_a_narrow_window_nothing_lies_over_the_stop(page, width):
    page.set_viewport_size({"width": width, "height": 900})
    controls = page.get_by_label("controller I", exact=True)
    expect(controls).not_to_be_in_viewport()
    page.get_by_label("show or hide the controls").click()
    expect(controls).to_be_in_viewport()
    page.locator("#pea-stop").click(trial=True)  # it would be hit
    page.get_by_label("show or hide the controls").click()
    page.set_viewport_size({"width": 1440, "height": 900})
    expect(controls).to_be_in_viewport()


@pytest.fixture
def themed(page):
    """Sets the page dark or light; it is light again in the end, whatever has failed."""
    yield lambda dark: page.evaluate("dark => Quasar.Dark.set(dark)", dark)
    page.evaluate("Quasar.Dark.set(false)")


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_an_accessibility_checker_finds_nothing_serious(page, themed, dark):
    """axe, at three sizes; at 1100 px all six plots can be seen, at 390 px the stop."""
    themed(dark)
    for width in (390, 1100, 1440):
        page.set_viewport_size({"width": width, "height": 900})
        page.locator("#pea-stop").click(trial=True)
        if width > 1000:
            for number in range(6):
                expect(page.locator("pea-scope canvas").nth(number)).to_be_in_viewport()
        assert not serious(page), f"{width} px"


def serious(page: Any) -> dict[str, list[str]]:
    """What an accessibility checker finds that is serious."""
    return {
        each["id"]: [node["html"][:200] for node in each["nodes"]]
        for each in Axe().run(page).response["violations"]
        if each["impact"] in ("serious", "critical")
    }


def test_dark_and_light_take_the_plots_with_them(page, themed):
    themed(False)

    def corner() -> list[int]:
        return page.evaluate(
            "Array.from(peaScope.plots[0].ctx.getImageData(1, 1, 1, 1).data).slice(0, 3)"
        )

    light = until(lambda: min(corner()) > 200 and corner())
    assert light
    page.get_by_label("light or dark").click()
    assert until(lambda: max(corner()) < 60)
    page.get_by_label("light or dark").click()
    assert until(lambda: corner() == light)


def test_the_end_of_the_dashboard_leaves_the_run_and_another_attaches(dashboard, page):
    (run,) = dashboard.runs()
    domain = re.search(r"ROS domain (\d+)", dashboard.said()).group(1)
    second = Dashboard(dashboard.there, "--attach", ROS_DOMAIN_ID=domain)
    try:
        until_served(second)
        assert until(lambda: '"running"' in read(second.address))
        assert second.end() == 0
    finally:
        if second.process.poll() is None:
            second.process.kill()
        second.process.wait()
    assert dashboard.runs() == [run]


def test_escape_ends_a_simulated_run_and_its_recording_is_looked_through(page, dashboard):
    page.keyboard.press("Escape")
    expect(page.locator("#pea-stopped")).to_have_text(
        re.compile(r"^Stopped: run \(process \d+\) ended")
    )
    expect(page.locator(".at-state")).to_have_text("no loop runs")
    assert until(lambda: not dashboard.runs())
    (run,) = (dashboard.there / "runs").glob(f"{EXPERIMENT}-*")
    page.get_by_text("Recordings", exact=True).click()
    page.get_by_role("button", name="Look again").click()
    page.get_by_label("show", exact=True).click()
    page.get_by_role("option", name=run.name).click()
    page.wait_for_function("peaScope.frame.first === 0 && peaScope.frame.arrays.y.length > 0")
    page.evaluate("peaScope.ask({end: 0.5, span: 0.2})")
    page.wait_for_function("Math.abs(peaScope.frame.t0 - 0.3) < 1e-9")
    recorded = page.evaluate("Array.from(peaScope.frame.arrays.y)")
    y = load(run, 0.3, 0.5)["y"]
    assert (min(recorded), max(recorded)) == pytest.approx((y.min() * 1e6, y.max() * 1e6), abs=1e-5)
    picture(page, "recording")


def test_the_emergency_stop_ends_a_rig_by_its_gate(page, dashboard):
    page.evaluate("peaScope.open('')")
    page.get_by_label("rig", exact=True).click()
    page.get_by_role("option", name="simulated_200hz").click()
    page.get_by_label("mode", exact=True).click()
    page.get_by_role("option", name="distributed").click()
    expect(page.get_by_label("controller K_i", exact=True)).to_have_value("300")  # the rig's
    page.get_by_text("Reference", exact=True).click()
    frequency = page.get_by_label("reference frequency_hz", exact=True)
    frequency.fill("1")
    frequency.press("Enter")
    page.get_by_role("button", name="Start").click()
    expect(page.locator(".at-safety")).to_have_text("active")
    page.get_by_label("width of the window").select_option("1")
    page.wait_for_function("peaScope.frame.arrays.y && peaScope.frame.last > 2")
    page.wait_for_function("peaScope.frame.rms_nm < 1000")  # it was 1 Hz that was asked for
    page.locator("#pea-stop").click()
    expect(page.locator("#pea-stopped")).to_have_text(re.compile("^Stopped: /pea/plant/stop"))
    failed = "failed: plant ended with status 3: the safety gate has tripped: emergency_stop"
    expect(page.locator(".at-outcome")).to_have_text(re.compile(failed))
    expect(page.locator(".at-state")).to_have_text("no loop runs")
    picture(page, "stopped")
    assert until(lambda: not dashboard.runs())
    assert page.complaints == []


@pytest.fixture
def scanner(tmp_path: Path) -> Iterator[tuple[Dashboard, Control]]:
    """A dashboard whose run drives two channels of an emulated device; a recording of a mirror."""
    sets = ["axes=[tip, tilt, piston]", "reference.tilt.frequency_hz=20"]
    experiment = experiments.load_axes(EXPERIMENT, [*sets, "reference.piston.amplitude_um=0"])
    loop, T_ns = experiment.loop(), 50_000
    with BagWriter(tmp_path / "runs" / "mirror", T_ns) as bag:
        bag.metadata(ORIGIN, origin("mirror", experiment.sections(), "batch", T_ns))
        record(bag, 0, T_ns, loop.run(400), ahead(loop), experiment.axes)
    command = [sys.executable, "-m", "pea_cli.cli", "emulate", "gcs", "--rig", SCANNER]
    emulator = subprocess.Popen([*command, "--port", "0"], stdout=subprocess.PIPE, text=True)
    address, control = (emulator.stdout.readline().strip() for _ in range(2))
    sets = [
        f"plant.driver.address={address}",
        *(
            "plant.driver.timeout_s=20",
            "plant.safety.watchdog_s=60",
            "reference.frequency_hz=1",
            "reference.y.frequency_hz=2",
        ),
        *(f"plant.safety.{name}=10000" for name in LOOSE),
        *(f"plant.safety.{name}=1000" for name in ("following_error_um", "jump_um")),
    ]
    named = [word for each in sets for word in ("--set", each)]
    run = ("--run", EXPERIMENT, "--rig", SCANNER, *named, "--duration", "600")
    started = Dashboard(tmp_path, *run, PEA_COMPILE="0")
    try:
        yield started, Control(control)
    finally:
        started.close()
        emulator.terminate()
        emulator.wait()
        emulator.stdout.close()


def test_two_axes_have_a_path_and_one_stop_stops_both(browser, scanner):
    dashboard, device = scanner
    page = opened(browser, dashboard)
    path = page.locator("[data-plot=path]")
    page.wait_for_function("peaScope.frame.arrays.y1 && peaScope.frame.last > 0.6")
    page.get_by_label("factor of the error").select_option("100")
    expect(path.get_by_role("img", name="error times 100")).to_be_visible()
    page.get_by_label("axis across").select_option("y")
    page.wait_for_function("peaScope.frame.path.join() === 'y,x'")
    until(lambda: all(abs(u) > 1.0 for u in voltages(device)))
    page.locator("#pea-stop").click()
    expect(page.locator("#pea-stopped")).to_have_text(re.compile("^Stopped: /pea/plant/stop"))
    assert voltages(device) == [0.0, 0.0]
    page.evaluate("peaScope.open('runs/mirror')")
    page.wait_for_function("peaScope.frame.arrays.y2 && peaScope.frame.last === 0.02")
    expect(path.get_by_role("img", name="piston as a bar")).to_be_visible()
    page.get_by_label("axis of the recording").select_option("tilt")
    page.wait_for_function("peaScope.frame.axis === 'tilt'")
    for width, dark in ((1100, True), (390, False)):
        page.set_viewport_size({"width": width, "height": 900})
        page.evaluate("dark => Quasar.Dark.set(dark)", dark)
        expect(path).to_be_visible()
        page.locator("#pea-stop").click(trial=True)
        assert not serious(page), f"{width} px"
    assert page.complaints == []
    page.close()


def voltages(device: Control) -> list[float]:
    """Voltages (V) that the channels of a device have."""
    axes = device.log()["axes"].values()
    return [own["last_voltage_V"]["value"] if own["last_voltage_V"] else 0.0 for own in axes]
