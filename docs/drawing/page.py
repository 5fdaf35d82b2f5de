"""Draws the states of the page of `palpate serve` in a browser, and a film's picture beside one.

python docs/drawing/page.py            # all
python docs/drawing/page.py home card  # some

It needs Chromium and playwright, and says so where they are not there. Without a graphics card a
state takes half a minute.
"""

import pathlib
import shutil
import sys
import tempfile
import threading

import imageio.v3 as imageio
import numpy as np

FOLDER = pathlib.Path(__file__).parents[1] / "pictures"
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WIDE, PHONE = (1280, 800), (390, 844)
# State -> size, what is clicked, and how hands move then: right, up, back [m], roll [rad], camera.
SMALL = {"right": (0.0, 0.0, 0.0, 0.05, 0.0)}
STATES = {
  "home": (WIDE, None, {}),
  "tutorial": (WIDE, "#tab-tutorial", {}),
  "exercise": (WIDE, "[data-task='touch/easy']", SMALL),
  "warning": (WIDE, "[data-task='grasp/easy']", {"right": (0.09, 0.0, 0.0, 0.0, 0.0)}),
  "two_hands": (WIDE, "[data-task='bimanual/easy']", {"right": (0.008, 0.0, 0.0, 0.0, 0.0)}),
  "needle": (WIDE, "[data-task='needle/transfer_standard']", SMALL),
  "suture": (WIDE, "[data-task='suture/drive_easy']", SMALL),
  "navigate": (WIDE, "[data-task='navigate/standard']", {"right": (0.0, 0.004, 0.0, 0.0, 0.04)}),
  "camera": (WIDE, "[data-task='grasp/easy']", {"scope": (-0.03, 0.0, 0.0, -0.9, 0.0)}),
  "cut": (WIDE, "[data-task='cut/standard']", {}),
  "card": (WIDE, "[data-task='touch/easy']", {"right": (0.01, 0.0, 0.0, 0.0, 0.0)}),
  "practice": (WIDE, "#tab-practice", {}),
  "line": (WIDE, "#tab-practice", {}),
  "burn": (WIDE, "#tab-practice", {}),
  "phone": (PHONE, "[data-task='trace/easy']", {"right": (0.006, 0.0, 0.0, 0.0, 0.0)}),
}
STOPPED = ("card",)
ANSWER = 120e3  # [ms]
# What the page knows, and its connection, to move the hand by.
LISTEN = """const {send} = WebSocket.prototype;
WebSocket.prototype.send = function(words) {
  window.program = this;
  return send.call(this, words);
};"""
LOOK = """(() => {
  const {head, scene, targets} = window.palpate();
  const {force, tip_x, tip_y, tip_z} = head;
  return {force, tip: [tip_x, tip_y, tip_z], mat: scene.camera.mat, targets};
})()"""
MOVE = """([move, buttons, which, jaw]) => window.program.send(JSON.stringify(
  {type: "hand", which: which ?? "right", move, rate: [0, 0, 0, 0], buttons, jaw}))"""
PRESS = 0.05  # of a hook on tissue [N]
DEEP, HIGH = -0.004, 0.012  # of a blade over the line [m]
CUT = 10  # marks along which it cuts


def cut(page) -> None:
  """Cuts along the beginning of a line, as a hand does."""
  targets = np.array(page.evaluate(LOOK)["targets"])[:CUT, :3]
  stations = [(targets[0], HIGH, 2e-3, 100), (targets[0], DEEP, 6e-4, 60)]
  for place, high, step, most in stations + [(each, DEEP, 4e-4, 40) for each in targets[1:]]:
    for _ in range(most):
      now = page.evaluate(LOOK)
      way = place + np.array([0, 0, high]) - now["tip"]
      if np.linalg.norm(way) < 1.2e-3:
        break
      way = np.reshape(now["mat"], (3, 3)).T @ way
      way *= min(2 * step / np.linalg.norm(way), 1)
      page.evaluate(MOVE, [[*map(float, way), 0.0], []])
      page.wait_for_timeout(50)


def line(page) -> None:
  """Draws a line on the organ with the mouse."""
  page.click("#draw")
  for k, turn in enumerate(np.linspace(-0.9, 1.2, 40)):
    page.mouse.move(400 + 110 * np.sin(turn), 380 + 120 * np.sin(2 * turn))
    if not k:
      page.mouse.down()
  page.mouse.up()
  page.click("#draw")


def burn(page) -> None:
  """Goes along the organ with a hook whose current is on, and leaves it on."""
  deeper, along = [0, 0, -8e-4, 0], [3e-4, 0, 0, 0]
  for _ in range(160):
    if page.evaluate(LOOK)["force"] > PRESS:
      break
    page.evaluate(MOVE, [deeper, []])
    page.wait_for_timeout(60)
  for _ in range(45):
    along[2] = -1e-4 if page.evaluate(LOOK)["force"] < 2 * PRESS else 5e-5
    page.evaluate(MOVE, [along, ["grip"]])
    page.wait_for_timeout(60)
  page.evaluate(f"hand => setInterval(() => ({MOVE})(hand), 50)", [[0, 0, 0, 0], ["grip"]])


HANDS = {"burn": burn, "cut": cut, "line": line}


def draw(browser, url: str, name: str) -> None:
  """Writes the picture of a state."""
  (width, height), start, moves = STATES[name]
  phone = (width, height) == PHONE
  page = browser.new_page(viewport={"width": width, "height": height}, has_touch=phone)
  page.add_init_script(LISTEN)
  page.goto(url if name in HANDS else f"{url}#look=wet")  # a hand does not wait for pictures
  page.wait_for_selector(".card", timeout=ANSWER)
  if phone:
    page.evaluate("document.body.classList.add('touch')")
  if start:
    if name not in HANDS:  # a slow machine would reach the time limit
      page.evaluate("document.getElementById('speed').value = 0.25")
    page.click(start)
    if start == "#tab-practice":
      page.select_option("#organ", "gallbladder")
      page.select_option("#instrument", "hook" if name == "burn" else "scalpel")
      page.click("#start")
    page.wait_for_selector("#stop:enabled", timeout=ANSWER)
    page.wait_for_timeout(3000)
  if name in HANDS:
    HANDS[name](page)
  for which, (*move, camera) in moves.items():
    steps = 40  # no hand jumps; a held key would go as far as the picture is slow
    for k in range(steps):
      turned = (k + 1) / steps * camera if camera else None
      page.evaluate(MOVE, [[x / steps for x in move], [], which, turned])
      page.wait_for_timeout(30)
    page.wait_for_timeout(2000)
  if name in STOPPED:
    page.dispatch_event("#stop", "click")
    page.wait_for_selector("#card[open]", timeout=ANSWER)
  page.wait_for_timeout(1500)
  shot = imageio.imread(page.screenshot(timeout=ANSWER), extension=".png")[..., :3]
  path = FOLDER / f"page_{name}.webp"
  imageio.imwrite(path, shot, quality=80)
  print(f"{path}: {path.stat().st_size // 1000} kB", flush=True)
  page.close()


def main() -> None:
  """Draws the states that are named, or all."""
  path = shutil.which("chromium") or shutil.which("google-chrome")
  try:
    from playwright.sync_api import sync_playwright
  except ImportError:
    path = None
  if path is None:
    print("no Chromium, or no playwright: nothing drawn")
    return
  from palpate.app.live.page.server import Server

  with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
    server = Server(pathlib.Path(folder), most=4)
    threading.Thread(target=server.run, daemon=True).start()
    browser = play.chromium.launch(executable_path=path, args=FLAGS)
    for name in sys.argv[1:] or STATES:
      draw(browser, server.url, name)
    browser.close()
    server.close()


if __name__ == "__main__":
  main()
