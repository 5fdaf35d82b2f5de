"""The page in a headless browser: looked at, and used as a trainee would."""

import pathlib
import shutil
import threading

import numpy as np
import pytest
from palpate.tasks.recording import Recording

pytest.importorskip("websockets")
from palpate.app.live.page.server import Server

ANSWER = 90.0  # that a busy machine may take [s]
FLAGS = ("--no-sandbox", "--enable-unsafe-swiftshader")
LOOK = """(() => {
  const {scene, head, targets} = window.palpate();
  const text = document.getElementById("instruction").textContent;
  return {head, targets, camera: scene.camera, text, ended: document.getElementById("card").open};
})()"""
# Every warning and tone that was shown.
WATCH = """(() => {
  const {body} = document, stage = document.getElementById("stage");
  const seen = (window.seen = new Set());
  const look = () => seen.add(`${stage.dataset.warning}`).add(`tone ${body.dataset.tone}`);
  for (const each of [stage, body]) new MutationObserver(look).observe(each, {attributes: true});
})()"""
# Pairs of things on the page that overlap, and what is partly outside it.
OVERLAP = """(() => {
  const found = [], over = "#stage p:not(:empty), #stage button";
  const seen = [...document.querySelectorAll(`${over}, header button, header label, aside h2`)]
    .filter(each => each.getClientRects().length && !each.closest("#more:not([open])"));
  const name = each => each.id || each.dataset.t || each.textContent;
  seen.forEach((one, i) => {
    const a = one.getBoundingClientRect(), {innerWidth: w, innerHeight: h} = window;
    const out = a.left < -1 || a.right > w + 1 || !one.closest("aside") && a.bottom > h + 1;
    if (out) found.push(`${name(one)} is outside`);
    for (const other of seen.slice(i + 1)) {
      const b = other.getBoundingClientRect();
      const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      if (wide > 2 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 2) {
        found.push(`${name(one)}, ${name(other)}`);
      }
    }
  });
  return found;
})()"""
# A gamepad that a test moves.
PAD = "window.pads = []; navigator.getGamepads = () => window.pads;"


# What the page plays, as a recording: the page's own contexts are replaced by ones without a card.
RECORD = """
window.heard = [];
window.AudioContext = class extends OfflineAudioContext {
  constructor() { super(1, 22050, 44100); window.heard.push(this); }
};
"""
HEARD = """async () => {
  const [context] = window.heard;
  return context ? [...(await context.startRendering()).getChannelData(0)] : [];
}"""
TONES = {"force": (880, 0.1), "shaft": (660, 0.1), "view": (330, 0.15), "end": (523, 0.3)}


class Pages:
  """A server, a browser, and one page that the tests share."""

  def __init__(self, folder, browser):
    self.folder, self.wrong = folder, []
    self.serve()
    self.page = page = browser.new_page(viewport={"width": 900, "height": 600})
    page.on("pageerror", lambda error: self.wrong.append(error))
    page.add_init_script(PAD)
    page.goto(f"{self.server.url}#task=touch/easy")
    page.wait_for_selector("#start:enabled", timeout=1e3 * ANSWER)

  def serve(self, port=0):
    self.server = Server(self.folder, port=port)
    self.thread = threading.Thread(target=self.server.run)
    self.thread.start()

  def close(self):
    self.server.close()
    self.thread.join(30)

  def until(self, what, text):
    """Waits until an expression of the page is true; the page lets nobody evaluate text itself."""
    for _ in range(int(10 * ANSWER)):
      if self.page.evaluate(what):
        return
      self.page.wait_for_timeout(100)
    raise AssertionError(f"{text}; the page says {self.page.inner_text('#fault')!r}")

  def speed(self, value):
    """Chooses one, among what is not always shown."""
    self.page.click("#more summary")
    self.page.select_option("#speed", value)
    self.page.click("#more summary")

  def start(self):
    """Starts what is chosen, and waits for its first pictures."""
    if self.page.is_visible("#card[open]"):  # a test before this one has failed
      self.page.click("#card button:text('Close')")
    if self.page.is_enabled("#stop"):
      self.stop()
    self.page.click("#start")
    self.page.wait_for_selector("#stop:enabled", timeout=1e3 * ANSWER)
    self.until("window.palpate().head.steps >= 0", "no picture")
    self.page.wait_for_timeout(200)
    head, practice = self.page.evaluate("[window.palpate().head, window.palpate().scene.practice]")
    assert practice or head["time"] == 0.0, "nobody has moved"
    self.page.focus("#view")
    for down in (True, False):  # the clock starts with a movement
      (self.page.keyboard.down if down else self.page.keyboard.up)("z")
      self.page.wait_for_timeout(60)
    self.until("window.palpate().head.steps > 50", "no picture")

  def stop(self):
    """Stops an exercise and returns what its card says."""
    self.page.dispatch_event("#stop", "click")  # the card may come meanwhile
    self.page.wait_for_selector("#card[open]", timeout=1e3 * ANSWER)
    text = self.page.inner_text("#card")
    self.page.click("#card button:text('Close')")
    return text

  def middle(self):
    box = self.page.locator("#view").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

  def drag(self, x, y, button="left"):
    a, b = self.middle()
    self.page.mouse.move(a, b)
    self.page.mouse.down(button=button)
    self.page.mouse.move(a + x, b + y)
    self.page.mouse.up(button=button)

  def picture(self):
    imageio = pytest.importorskip("imageio.v3")
    shot = self.page.locator("#view").screenshot()
    return imageio.imread(shot, extension=".png")[..., :3].astype(int)

  def ink(self, name):
    """Whether a plot shows a curve."""
    found = f"""(() => {{
      const canvas = document.getElementById("plot-{name}");
      const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
      return pixels.some((x, i) => i % 4 === 1 && x > 190);
    }})()"""
    return self.page.evaluate(found)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
  api = pytest.importorskip("playwright.sync_api")
  path = shutil.which("chromium") or shutil.which("google-chrome")
  if path is None:
    pytest.skip("no chromium")
  with api.sync_playwright() as play:
    browser = play.chromium.launch(executable_path=path, args=FLAGS)
    made = Pages(tmp_path_factory.mktemp("live") / "out", browser)
    yield made
    browser.close()
    made.close()
  assert made.wrong == []


def look(page, height, above):
  """Returns the page's numbers, the way in the picture [m] to a place above the target, and the
  size of a pixel [m]."""
  state = page.evaluate(LOOK)
  head, camera = state["head"], state["camera"]
  tip, axes = [head[f"tip_{axis}"] for axis in "xyz"], np.array(camera["mat"]).reshape(3, 3)
  depth = (np.array(camera["pos"]) - tip) @ axes[:, 2]
  pixel = 2 * depth * np.tan(np.radians(camera["fovy"] / 2)) / height
  return state, axes.T @ (np.array(state["targets"][0][:3]) + np.array([0, 0, above]) - tip), pixel


def test_an_exercise_is_done_through_the_page(pages, tmp_path):
  """The picture has the organ's red; a script touches the point by mouse and sees its score."""
  page = pages.page
  assert page.input_value("#task") == "touch/easy"
  pages.speed("0.25")
  pages.start()
  assert page.inner_text("#instruction") == "Touch the yellow point gently, 1 of 1"
  shot = pages.picture()
  assert ((shot[..., 0] > 70) & (shot[..., 0] > 1.5 * shot[..., 1])).mean() > 0.1
  box = page.locator("#view").bounding_box()
  middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
  above = 0.01  # of the point, where the tip is taken [m]
  for _ in range(400):
    state, to, pixel = look(page, box["height"], above)
    if state["ended"]:
      break
    force = state["head"]["force"]
    if force > 0.3 or "Let go" in state["text"]:
      above += 0.002
    elif force < 0.05 and np.linalg.norm(to) < 0.0015:
      above -= 0.001 if above > 0.003 else 0.0003
    if np.linalg.norm(to[:2]) > 0.0005:
      x, y = np.clip(0.6 * to[:2] / pixel, -40, 40)
      page.mouse.move(*middle)
      page.mouse.down()
      page.mouse.move(middle[0] + x, middle[1] - y)
      page.mouse.up()
    page.mouse.wheel(0, float(np.clip(0.6 * to[2], -0.002, 0.002) / 2e-5))
    for _ in range(100):  # until it is seen
      page.wait_for_timeout(30)
      if page.evaluate("window.palpate().head.time") > state["head"]["time"] + 0.03:
        break

  page.wait_for_selector("#card[open]", timeout=1e3 * ANSWER)
  page.screenshot(path=str(tmp_path / "card.png"))
  text = pages.stop()
  assert "Success, after" in text and "Done" in text and "What to do next" in text
  kept = max(pages.folder.glob("*.npz"), key=lambda path: path.stat().st_mtime)
  assert Recording.load(kept).outcome == "success" and pathlib.Path(kept).parent == pages.folder
  pages.speed("1")


@pytest.mark.parametrize("kind", TONES)
def test_a_tone_is_what_is_heard(pages, kind):
  """Recorded by the browser: pitch, loudness and length; nothing where the sound is off."""
  page = pages.page.context.browser.new_page()
  page.add_init_script(RECORD)
  page.goto(f"{pages.server.url}card.js")  # any file: the modules are beside it
  speak = "async ([kind, on]) => (await import('/sounds.js')).speaker(() => on)(kind)"
  page.evaluate(speak, [kind, False])
  assert page.evaluate(HEARD) == []
  page.evaluate(speak, [kind, True])
  wave, (pitch, length) = np.array(page.evaluate(HEARD)), TONES[kind]
  on = np.flatnonzero(np.abs(wave) > 1e-3)
  assert (on[-1] - on[0]) / 44100 == pytest.approx(length, abs=0.004)
  sound = wave[on[0] : on[-1]]
  assert np.sqrt((sound**2).mean()) == pytest.approx(0.2 / np.sqrt(2), rel=0.06)
  spectrum = np.abs(np.fft.rfft(sound * np.hanning(len(sound)), 2**17))
  assert spectrum.argmax() * 44100 / 2**17 == pytest.approx(pitch, abs=1.0)
  page.close()


# A triangle that is drawn on from above and lifted by a centimetre; a tip touches beside the line.
DRAW = """async () => {
  const {Line} = await import("/scene/line.js");
  const {Scene} = await import("/three/three.module.min.js");
  const line = new Line(new Scene()), x = new Float32Array([0, 0, 0, 0.1, 0, 0, 0, 0.1, 0]);
  const down = [0, 0, -1];
  for (let k = 0; k < 9; k++) line.add([0.01 + 0.003 * k, 0.02, 0.1], down, x, [0, 1, 2]);
  line.add([0.034, 0.0201, 0.1], down, x, [0, 1, 2]);  // too near to the last one
  line.add([0.2, 0.2, 0.1], down, x, [0, 1, 2]);  // beside the organ
  for (const k of [2, 5, 8]) x[k] = 0.01;
  line.drape(x);
  const tip = {tip_x: 0.022, tip_y: 0.022, tip_z: 0.01};
  const follow = force => line.measure({...tip, force});
  return [line.at, line.dots.count, follow(0), follow(0.1)];
}"""


def test_a_line_lies_on_the_tissue_and_is_followed(pages):
  page = pages.page.context.browser.new_page()
  page.goto(f"{pages.server.url}card.js")
  at, count, before, after = page.evaluate(DRAW)
  assert count == len(at) == 9
  expected = [[0.01 + 0.003 * k, 0.02, 0.01] for k in range(9)]
  np.testing.assert_allclose(at, expected, atol=1e-7)
  assert before == [0, 0]
  assert after == [pytest.approx(1 / 9), pytest.approx(0.002, abs=1e-6)]
  page.close()


# A thread around a quarter of a circle, whose last edge has broken.
TUBE = """async () => {
  const {Thread} = await import("/scene/thread.js");
  const three = await import("/three/three.module.min.js");
  const thread = new Thread(new three.Scene(), 7, 1e-4, null);
  const turn = k => [0.01 * Math.cos(Math.PI * k / 12), 0.01 * Math.sin(Math.PI * k / 12)];
  thread.drape(Array.from({length: 7}, (_, k) => [...turn(k), 0, k === 5 ? 0 : 1]).flat());
  const {position, normal} = thread.geometry.attributes;
  return [[...position.array], [...normal.array], [...thread.geometry.index.array]];
}"""


def test_a_thread_is_a_round_tube_through_its_nodes(pages):
  page = pages.page.context.browser.new_page()
  page.goto(f"{pages.server.url}card.js")
  x, normal, faces = (np.reshape(each, (-1, 3)) for each in page.evaluate(TUBE))
  around = np.degrees(np.arctan2(x[:, 1], x[:, 0]))
  far = np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.01, x[:, 2])  # from the circle
  whole = (around > 14) & (around < 61)
  assert far[whole] == pytest.approx(1e-4, rel=0.05)
  assert np.abs(x[(around > 76) & (around < 89), 2]).max() < 1e-9  # nothing is where it has broken
  corners = x[faces[whole[faces].all(axis=1)]]
  out = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
  assert (out * normal[faces[whole[faces].all(axis=1), 0]]).sum(axis=1).min() > 0  # faces outward
  page.close()


@pytest.mark.slow
def test_too_much_force_and_a_lost_tip_are_seen_and_heard(pages):
  """Each in a colour and with a tone of its own, and noted in the recording."""
  page = pages.page
  page.evaluate(WATCH)
  for keys, kind, speed in (("d", "view", "1"), ("qs", "force", "0.1")):
    pages.speed(speed)
    pages.start()
    page.focus("#view")
    for key in keys:
      page.keyboard.down(key)
    pages.until(f"seen.has('{kind}') && seen.has('tone {kind}')", f"no warning of {kind}")
    for key in keys:
      page.keyboard.up(key)
    pages.stop()
  pages.speed("1")
  kept = max(pages.folder.glob("*.npz"), key=lambda path: path.stat().st_mtime)
  hints = Recording.load(kept).info["coach"]["hints"]
  assert any(hint["kind"] == "warning" and "Too much force" in hint["text"] for hint in hints)


@pytest.mark.slow
@pytest.mark.parametrize("language", ["en", "de"])
def test_nothing_overlaps_on_phones_and_tablets(pages, language):
  """With every line of words, and the buttons that a moved camera adds."""
  page = pages.page
  page.evaluate("document.body.classList.add('touch')")
  page.select_option("#language", language, force=True)
  pages.start()
  page.click("#scope")
  words = "Too much force: 0.9 N, expected at most 0.4 N, and something that takes two lines"
  page.evaluate("""text => {
    for (const id of ["warning", "fault"]) document.getElementById(id).textContent = text;
  }""", words)  # fmt: skip
  for width, height in ((360, 740), (390, 844), (768, 1024), (1024, 768), (844, 390)):
    page.set_viewport_size({"width": width, "height": height})
    page.wait_for_timeout(150)
    assert page.evaluate(OVERLAP) == [], (width, height)
  page.set_viewport_size({"width": 900, "height": 600})
  page.click("#scope")
  page.evaluate("document.body.classList.remove('touch')")
  page.select_option("#language", "en", force=True)
  pages.stop()


@pytest.mark.slow
def test_an_assessment_is_without_help(pages):
  page = pages.page
  page.check("#assessment")
  pages.start()
  page.mouse.move(*pages.middle())
  page.mouse.wheel(0, -1000)
  pages.until("window.palpate().head.time > 0.5", "no time")
  assert not page.is_visible("#force") and not page.is_visible("#ghost")
  assert page.inner_text("#warning") == "" and "no help" in page.inner_text("#instruction")
  assert page.evaluate("document.getElementById('stage').dataset.warning") == ""
  assert "Stopped before the end" in pages.stop()
  page.uncheck("#assessment")


@pytest.mark.slow
def test_the_expert_is_drawn_on_request(pages):
  page = pages.page
  pages.start()
  page.click("#pause")
  before = pages.picture()
  page.click("#ghost")
  pages.until("window.palpate().ghost > 0", "no expert")
  page.wait_for_timeout(300)
  green = pages.picture() - before
  assert ((green[..., 1] > 40) & (green[..., 1] > green[..., 0])).sum() > 100
  pages.stop()


@pytest.mark.slow
def test_free_practice_on_the_page(pages):
  """Everything is changed while it runs; the picture turns, moves, scales, shows the mesh."""
  page = pages.page
  page.click("#tab-practice")
  page.select_option("#mesh", "16 x 16")
  pages.start()
  page.get_by_text("Speed of the simulation").click()
  for name in ("force", "way", "rate"):
    assert page.is_visible(f"#plot-{name}")
  pages.until("window.palpate().head.time > 0.5", "no time")
  page.wait_for_timeout(600)  # a plot is drawn ten times a second
  assert pages.ink("rate") and "steps a second" in page.inner_text("#loop")
  shots = [pages.picture()]
  page.click("#wire")
  for act in (
    lambda: None,
    lambda: (page.click("#free"), pages.drag(120, 40)),
    lambda: pages.drag(80, 0, "right"),
    lambda: page.mouse.wheel(0, 400),
  ):
    act()
    page.wait_for_timeout(200)
    shots.append(pages.picture())
    assert np.abs(shots[-1] - shots[-2]).mean() > 1
  page.click("#free")
  page.click("#wire")
  page.wait_for_timeout(200)
  assert np.abs(pages.picture() - shots[0]).mean() < 1  # where it was
  page.select_option("#scheme", "neumann")
  page.select_option("#mesh", "32 x 32")
  pages.until("window.palpate().scene.nodes === 1026", "no other mesh")
  pages.until("window.palpate().head.steps > 0", "no steps")
  assert page.input_value("#scheme") == "neumann"


@pytest.mark.slow
def test_keys_gamepad_and_buttons_move_the_tip(pages):
  """In the free practice of the test before."""
  page = pages.page
  tip = "((h) => [h.tip_x, h.tip_y, h.tip_z])(window.palpate().head)"
  page.focus("#view")
  for on, off in (
    (lambda: page.keyboard.down("w"), lambda: page.keyboard.up("w")),
    (
      lambda: page.evaluate("void (window.pads = [{axes: [0.9, 0, 0, 0], buttons: []}])"),
      lambda: page.evaluate("void (window.pads = [])"),
    ),
    (
      lambda: page.dispatch_event("[data-rate='2,1']", "pointerdown"),
      lambda: page.dispatch_event("[data-rate='2,1']", "pointerup"),
    ),
  ):
    before = np.array(page.evaluate(tip))
    on()
    for _ in range(int(10 * ANSWER)):
      page.wait_for_timeout(100)
      if np.linalg.norm(np.array(page.evaluate(tip)) - before) > 0.005:
        break
    off()
    assert np.linalg.norm(np.array(page.evaluate(tip)) - before) > 0.005
  page.click("#stop")
  page.wait_for_selector("#start:enabled", timeout=1e3 * ANSWER)
  page.click("#tab-exercise")


@pytest.mark.slow
def test_a_wrist_is_turned_by_mouse_keys_gamepad_and_buttons(pages):
  page = pages.page
  page.select_option("#task", "suture/drive_easy")
  pages.start()
  axes = "((h) => [h.tip_qw, h.tip_qx, h.tip_qy, h.tip_qz])(window.palpate().head)"
  up = "[data-rate='4,1']"
  pad = "[{axes: [0, 0, 0, 0], buttons: Array.from({length: 16}, (_, i) => ({pressed: i == 14}))}]"

  def turned(before):
    return 2 * np.arccos(min(abs(before @ page.evaluate(axes)), 1.0))

  for on, off in (
    (lambda: page.keyboard.press("Shift+ArrowUp", delay=300), lambda: None),
    (lambda: pages.drag(0, -30), lambda: None),
    (lambda: page.mouse.wheel(0, 300), lambda: None),
    (
      lambda: page.evaluate(f"void (window.pads = {pad})"),
      lambda: page.evaluate("void (window.pads = [])"),
    ),
    (lambda: page.dispatch_event(up, "pointerdown"), lambda: page.dispatch_event(up, "pointerup")),
  ):
    before = np.array(page.evaluate(axes))
    page.keyboard.down("Shift")
    on()
    page.keyboard.up("Shift")
    for _ in range(int(10 * ANSWER)):
      page.wait_for_timeout(100)
      if turned(before) > 0.1:
        break
    off()
    assert turned(before) > 0.1
  assert page.get_attribute(up, "hidden") is None
  pages.stop()
  page.select_option("#task", "touch/easy")


@pytest.mark.slow
def test_a_program_that_ends_is_named_and_found_again(pages):
  pages.close()
  said = "document.getElementById('fault').textContent.includes('No connection')"
  pages.until(said, "nothing said")
  assert not pages.page.is_enabled("#start")
  pages.serve(pages.server.port)
  pages.page.wait_for_selector("#start:enabled", timeout=1e3 * ANSWER)
  assert pages.page.inner_text("#fault") == ""


@pytest.mark.slow
def test_an_exercise_that_is_not_there_is_named(pages):
  pages.page.goto(f"{pages.server.url}#task=touch/nothing")
  pages.page.reload()
  said = "document.querySelector('#home .fault').textContent.includes('touch/nothing')"
  pages.until(said, "nothing said")
  assert pages.page.is_visible("#home .fault")
