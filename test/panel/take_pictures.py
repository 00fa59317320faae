"""Makes the pictures of the documentation; `pictures` calls it with their folder.

The boards are simulated or emulated.
"""
import base64
import contextlib
import html
import math
import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / 'ros'), str(Path(__file__).parent)]

import measured_pictures  # noqa: E402
from boards import Bridge, BusBoard, CarBoard, Line, program  # noqa: E402
from panel_browser import Browser  # noqa: E402
from robot import NODE, Core, Panel  # noqa: E402
from test_smoke import choose  # noqa: E402

HISTORY = 45            # s before a picture, so that the plots have data
SPEED, STEERING = 300, 1650
WIDTH, HEIGHT = 900, 560    # px of the page in the animation: that of a README
COLUMNS, ROWS = 110, 30     # of its terminal
BELOW = 288                 # px for its caption and terminal
PACE = 0.25                 # s from one of its pictures to the next

# The numbers of the pictures in which it happens.
PRESSED, PULLED, RELEASED, BACK, PRESSED_AGAIN, RELEASED_AGAIN, SCENES = 6, 30, 38, 50, 60, 80, 86
CAPTIONS = ((0, ('#333b45', 'The page in the browser, and the table in a terminal')),
            (PRESSED, ('#1b62b5', 'The pad drives the car')),
            (PULLED, ('#c31f2d', 'The plug of the car’s board is pulled')),
            (BACK, ('#14703f', 'It is plugged in again')),
            (PRESSED_AGAIN, ('#1b62b5', 'The car drives again')))

_STYLE = '''<style>
  body { margin: 0; background: #14171b; color: #d7dce2; }
  pre { font: 13px/1.35 "DejaVu Sans Mono", monospace; margin: 0; padding: 8px 16px; }
  img { display: block; }
  h1 { font: bold 17px/36px "DejaVu Sans", sans-serif; margin: 0; padding: 0 16px; color: #fff; }
  svg { position: absolute; }
  .c1 { color: #ff8a92; } .c2 { color: #5fd39a; } .c3 { color: #f2b824; }
</style>'''
_POINTER = '''<svg width="22" height="30" style="left: {}px; top: {}px">
<path d="M1 1v22l6-5 4 9 4-2-4-9h8z" fill="#000" stroke="#fff" stroke-width="1.5"/></svg>'''


@contextlib.contextmanager
def running(*command, **options):
    """Run a program until the end of the block."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                               **options)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


class Terminal:
    """The live table in a terminal of its own."""

    def __init__(self):
        self._far, near = pty.openpty()
        subprocess.run(['stty', 'rows', str(ROWS), 'cols', str(COLUMNS)], stdin=near, check=True)
        self.process = subprocess.Popen([program('monitor')], stdout=near)
        self._printed = b''
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        while True:
            self._printed += os.read(self._far, 4096)

    def table(self):
        """The latest table, as HTML."""
        tables = self._printed.decode(errors='replace').split('\033[J')
        text = re.sub('\033\\[(2K|\\d+F)|\r', '', tables[-2]) if len(tables) > 1 else ''
        return re.sub('\033\\[3(.)m(.*)\033\\[0m', r'<span class="c\1">\2</span>',
                      html.escape(text, quote=False))


def film(page, line, terminal):
    """The pictures of the animation as HTML: the car is driven, its plug is pulled, it is back."""
    box = page.script('return document.getElementById("pad").getBoundingClientRect().toJSON()')
    scenes, at = [], [0, 0]

    def mouse(kind, right, up):
        at[:] = box['x'] + box['width'] / 2 + right, box['y'] + box['height'] / 2 - up
        page.driver.execute_cdp_cmd('Input.dispatchMouseEvent', {
            'type': f'mouse{kind}', 'x': at[0], 'y': at[1], 'button': 'left', 'buttons': 1,
            'clickCount': 1})
    mouse('Moved', 60, -60)
    events = {PULLED: line.unplug, RELEASED: lambda: mouse('Released', 30, 60), BACK: line.plug,
              RELEASED_AGAIN: lambda: mouse('Released', 30, 60)}
    began = time.monotonic()
    for number in range(SCENES):
        time.sleep(max(0.0, began + number * PACE - time.monotonic()))
        events.get(number, bool)()
        if PRESSED <= number < RELEASED or PRESSED_AGAIN <= number < RELEASED_AGAIN:
            place = 70 * math.sin((number - PRESSED) * PACE), 75
            mouse('Moved', *place)
            if not page.attribute('#pad', 'data-held'):     # a stall may end it
                mouse('Released', *place)
                mouse('Pressed', *place)
        shown = base64.b64encode(page.picture()).decode()
        colour, words = [each for since, each in CAPTIONS if number >= since][-1]
        scenes.append(f'<!DOCTYPE html><meta charset="utf-8">{_STYLE}<body>'
                      f'<img src="data:image/png;base64,{shown}">{_POINTER.format(*at)}'
                      f'<h1 style="background: {colour}">{words}</h1>'
                      f'<pre>{terminal.table()}</pre>')
    return scenes


def animate(browser, scenes, path):
    """Save an animation."""
    with tempfile.TemporaryDirectory(prefix='scenes_') as folder:
        pictures = [Path(folder, f'{number:03d}.png') for number in range(len(scenes))]
        for scene, picture in zip(scenes, pictures):
            page = picture.with_suffix('.html')
            page.write_text(scene)
            browser.open(page.as_uri())
            picture.write_bytes(browser.picture())
        subprocess.run(['convert', '-delay', f'{PACE * 100:.0f}', '-loop', '0',
                        *map(str, pictures), '-layers', 'optimize', '-dither', 'None',
                        '-colors', '64', str(path)], check=True)
    print(f'{path}: {path.stat().st_size / 1024:.0f} KiB', flush=True)


def driving(stack):
    """Drive in a circle."""
    for name, kind, value in (('speed', 'SpeedPWMCommand', SPEED),
                              ('steering', 'SteeringPWMCommand', STEERING)):
        stack.enter_context(running(
            'rostopic', 'pub', '-r', '10', f'{NODE}/{name}',
            f'serial_communication/{kind}', f'{{value: {value}}}'))


def take_rviz(out):
    """Take rviz on a virtual screen."""
    reading, writing = os.pipe()
    with contextlib.ExitStack() as stack:
        stack.enter_context(running('Xvfb', '-displayfd', str(writing), '-screen', '0',
                                    '1200x750x24', '-nolisten', 'tcp', pass_fds=[writing]))
        os.close(writing)
        with os.fdopen(reading) as number:
            display = f':{number.readline().strip()}'
        stack.enter_context(running('roslaunch', 'serial_communication', 'view.launch',
                                    'sim:=true', env={**os.environ, 'DISPLAY': display}))
        driving(stack)
        time.sleep(HISTORY)
        subprocess.run(['import', '-display', display, '-window', 'root', '-dither', 'None',
                        '-colors', '128', f'png8:{out / "rviz.png"}'], check=True)


def take_page(browser, folder, out):
    """Take the animation of the page and the terminal."""
    with contextlib.ExitStack() as stack:
        lines = {name: Line(folder / name).plug() for name in ('bus', 'arduino')}
        for line in lines.values():
            stack.callback(line.unplug)
        stack.callback(BusBoard(lines['bus'].far).close)
        stack.callback(CarBoard(lines['arduino'].far, measures=True).close)
        stack.callback(Bridge(parameters={
            f'{name}/port': line.near for name, line in lines.items()}).end)
        panel, terminal = stack.enter_context(Panel('--control')), Terminal()
        stack.callback(terminal.process.terminate)
        browser.resize(WIDTH, HEIGHT)
        browser.open(panel.url)
        choose(browser, 'car')
        browser.script("""const limit = document.querySelector('[aria-label^="forward"]');
                       limit.value = 600; limit.dispatchEvent(new Event('input'));""")
        time.sleep(HISTORY)
        scenes = film(browser, lines['arduino'], terminal)
        browser.open('about:blank')
    browser.resize(WIDTH, HEIGHT + BELOW)
    animate(browser, scenes, out / 'panel.gif')


def main():
    """Take all pictures."""
    out = Path(sys.argv[1])
    core = Core().start()
    browser = Browser()
    with tempfile.TemporaryDirectory(prefix='pictures_') as folder:
        try:
            (out / 'diff_drive_square.svg').write_text(measured_pictures.square())
            (out / 'tuning.svg').write_text(measured_pictures.tuning())
            (out / 'board_time.svg').write_text(measured_pictures.stamps())
            take_page(browser, Path(folder), out)
            take_rviz(out)
        finally:
            browser.quit()
            core.end()


if __name__ == '__main__':
    main()
