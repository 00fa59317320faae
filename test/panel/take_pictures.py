"""Makes the pictures of the documentation; `pictures` calls it with their folder.

The boards are simulated or emulated.
"""
import contextlib
import html
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / 'ros'), str(Path(__file__).parent)]

import measured_pictures  # noqa: E402
from boards import program  # noqa: E402
from panel_browser import Browser  # noqa: E402
from robot import NODE, Core, Panel  # noqa: E402

HISTORY = 45            # s before a picture, so that the plots have data
WIDTH, HEIGHT = 1180, 1000   # of the page: its text can still be read at the width of a README
SCENES, PACE = 20, 0.5      # pictures of the animation, and s from one to the next
SPEED, STEERING = 300, 1650

_TERMINAL = '''<style>
  body { margin: 0; background: #14171b; color: #d7dce2; width: max-content; white-space: pre;
         font: 15px/1.35 "DejaVu Sans Mono", monospace; padding: 18px 22px; }
</style>'''


@contextlib.contextmanager
def running(*command, **options):
    """Run a program until the end of the block."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                               **options)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()


def save(picture, path):
    """Save a PNG with few colours, so that the file is small."""
    subprocess.run(['convert', '-', '-strip', '-dither', 'None', '-colors', '128',
                    '-define', 'png:compression-level=9', f'png8:{path}'],
                   input=picture, check=True)
    print(f'{path}: {path.stat().st_size / 1024:.0f} KiB', flush=True)


def animate(browser, path):
    """Save an animation of the page."""
    with tempfile.TemporaryDirectory(prefix='scenes_') as folder:
        scenes = [Path(folder, f'{number:02d}.png') for number in range(SCENES)]
        for scene in scenes:
            began = time.monotonic()
            scene.write_bytes(browser.picture())
            time.sleep(max(0.0, began + PACE - time.monotonic()))
        subprocess.run(['convert', '-delay', f'{PACE * 100:.0f}', '-loop', '0', *map(str, scenes),
                        '-resize', '800x', '-dither', 'None', '-colors', '48', '+map',
                        '-layers', 'optimize', str(path)], check=True)
    print(f'{path}: {path.stat().st_size / 1024:.0f} KiB', flush=True)


def driving(stack):
    """Drive in a circle."""
    for name, kind, value in (('speed', 'SpeedPWMCommand', SPEED),
                              ('steering', 'SteeringPWMCommand', STEERING)):
        stack.enter_context(running(
            'rostopic', 'pub', '-r', '10', f'{NODE}/{name}',
            f'serial_communication/{kind}', f'{{value: {value}}}'))


def take_terminal(browser, folder, out):
    """Take the output of `monitor`, as large as its text."""
    text = subprocess.run([program('monitor'), '--once'], stdout=subprocess.PIPE).stdout.decode()
    page = folder / 'terminal.html'
    page.write_text(f'<!DOCTYPE html><meta charset="utf-8">{_TERMINAL}<body>{html.escape(text)}')
    browser.open(page.as_uri())
    browser.resize(*browser.script(
        'return [document.body.scrollWidth, document.body.scrollHeight]'))
    save(browser.picture(), out / 'terminal.png')


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
        save(subprocess.run(['import', '-display', display, '-window', 'root', 'png:-'],
                            stdout=subprocess.PIPE, check=True).stdout, out / 'rviz.png')


def take_intact(browser, folder, out):
    """Take an animation of the page, and the terminal. rviz would take the processor."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(running('roslaunch', 'serial_communication', 'bridge.launch',
                                    'sim:=true'))
        driving(stack)
        panel = Panel('--control')
        stack.callback(panel.__exit__, None)
        browser.resize(WIDTH, HEIGHT)
        browser.open(panel.url)
        browser.wait(lambda page: page.attribute('[data-link="bus"]', 'data-health') == 'ok',
                     'the bridge runs', 60)
        time.sleep(HISTORY)
        animate(browser, out / 'panel.gif')
        take_terminal(browser, folder, out)


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
            take_intact(browser, Path(folder), out)
            take_rviz(out)
        finally:
            browser.quit()
            core.end()


if __name__ == '__main__':
    main()
