"""Makes the pictures of the documentation; scripts/pictures calls it with their folder.

The boards are simulated: first with intact lines, then with a bad cable.
"""
import contextlib
import html
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time
from fcntl import ioctl
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / 'ros'), str(Path(__file__).parent)]

import panel_helpers  # noqa: E402
import square_picture  # noqa: E402
import stamps_picture  # noqa: E402
import tuning_picture  # noqa: E402
from boards import Bridge, Line, program  # noqa: E402
from panel_browser import Browser  # noqa: E402

HISTORY = 45            # s before a picture, so that the plots have data
WIDTH, HEIGHT = 1180, 1000   # of the page: its text can still be read at the width of a README
SCENES, PACE = 20, 0.5      # pictures of the animation, and s from one to the next
COLUMNS, ROWS = 100, 34  # of the terminal
SPEED, STEERING = 300, 1650
PHONE = 390, 560         # of its page, less than its screen
GAINS = '''
arduino:
  settings:
    kp: {setting: 1, layout: "<f", minimum: 0, maximum: 200, unit: PWM/(turn/s),
         description: proportional gain}
    ki: {setting: 2, layout: "<f", minimum: 0, maximum: 1000, unit: PWM/turn,
         description: integral gain}
    kd: {setting: 3, layout: "<f", minimum: 0, maximum: 20, unit: PWM/(turn/s^2),
         description: derivative gain}
'''

_TERMINAL = '''<style>
  body { margin: 0; background: #14171b; color: #d7dce2; width: max-content;
         font: 15px/1.35 "DejaVu Sans Mono", monospace; padding: 18px 22px; white-space: pre; }
  .s1 { font-weight: bold; color: #fff } .s32 { color: #5fd39a } .s33 { color: #f2b824 }
  .s31 { color: #ff6b75 }
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
            'rostopic', 'pub', '-r', '10', f'{panel_helpers.NODE}/{name}',
            f'serial_communication/{kind}', f'{{value: {value}}}'))


def terminal(folder):
    """The output of `monitor` as a file of HTML."""
    near, far = pty.openpty()
    ioctl(far, termios.TIOCSWINSZ, struct.pack('HHHH', ROWS, COLUMNS, 0, 0))
    shown = bytearray()
    process = subprocess.Popen([program('monitor')], stdin=far, stdout=far, stderr=far,
                               env={**os.environ, 'TERM': 'xterm'})
    os.close(far)
    with contextlib.suppress(OSError):
        end = time.monotonic() + 12
        while time.monotonic() < end:
            shown += os.read(near, 65536)
            if time.monotonic() > end - 1 and process.poll() is None:
                break
    whole = bytes(shown).decode().split('\033[H')[-2]        # the last complete one
    process.terminate()
    with contextlib.suppress(OSError):
        while os.read(near, 65536):
            pass
    process.wait(10)
    os.close(near)
    text = re.sub(r'\033\[0?m', '</span>', html.escape(whole))
    text = re.sub(r'\033\[(\d+)m', r'<span class="s\1">', text)
    text = re.sub(r'\033\[[?0-9]*[A-Za-z]', '', text).replace('\r', '').rstrip()
    page = folder / 'terminal.html'
    page.write_text(f'<!DOCTYPE html><meta charset="utf-8">{_TERMINAL}<body>{text}')
    return page


def take_terminal(browser, folder, out):
    """Take the picture of the terminal, as large as its text."""
    browser.open(terminal(folder).as_uri())
    width, height = browser.script(
        'return [document.body.scrollWidth, document.body.scrollHeight]')
    browser.resize(width, height)
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
    """Take the page, an animation of it, and the terminal. rviz would take the processor."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(running('roslaunch', 'serial_communication', 'bridge.launch',
                                    'sim:=true'))
        driving(stack)
        panel = panel_helpers.Panel('--control')
        stack.callback(panel.end)
        browser.resize(WIDTH, HEIGHT)
        browser.open(panel.url)
        browser.wait(lambda page: page.attribute('[data-link="bus"]', 'data-health') == 'ok',
                     'the bridge runs', 60)
        browser.focus()
        time.sleep(HISTORY)
        for service, button in (('~gimbal', 2), ('~lift', 1)):
            browser.click(f'[data-service="{service}"] button:nth-of-type({button})')
            browser.wait(lambda page: page.all(f'[data-service="{service}"] button')[0]
                         .is_enabled(), 'the call is answered')
        browser.wait(lambda page: not page.all('[data-state="stale"]'), 'all values are new')
        save(browser.picture(), out / 'panel.png')
        animate(browser, out / 'panel.gif')
        take_terminal(browser, folder, out)


def take_faulty(browser, folder, out):
    """Take the page in dark mode and the wire; one cable is bad, one unplugged."""
    lines = {name: Line(str(folder / name)).plug() for name in ('bus', 'arduino', 'mcu')}
    with contextlib.ExitStack() as stack:
        for name, line in lines.items():
            stack.callback(line.unplug)
            stack.enter_context(running(
                program('simulator'), name, '--port', line.far, '--seed', '7',
                *(['--faults', 'flip=0.005'] if name == 'arduino' else [])))
        bridge = Bridge(parameters={f'{name}/port': line.near for name, line in lines.items()})
        stack.callback(bridge.end)
        driving(stack)
        panel = panel_helpers.Panel()
        stack.callback(panel.end)
        browser.resize(WIDTH, HEIGHT)
        browser.scheme('dark')
        browser.open(panel.url)
        browser.wait(lambda page: page.attribute('[data-link="arduino"]', 'data-health') == 'warn',
                     'the cable is bad', 60)
        time.sleep(HISTORY)
        lines['mcu'].unplug()
        browser.wait(lambda page: page.attribute('[data-link="mcu"]', 'data-health') == 'error',
                     'the other is unplugged')
        save(browser.picture(), out / 'panel_dark.png')
        browser.scheme('light')
        browser.click('#card-wire > summary')
        browser.wait(lambda page: page.all('.frame[data-error]'), 'a damaged frame is shown', 60)
        browser.script("document.querySelector('.frame[data-error]').click();"
                       "document.getElementById('card-wire').scrollIntoView()")
        browser.wait(lambda page: page.all('.fields'), 'it is explained')
        save(browser.picture('#card-wire'), out / 'panel_wire.png')


def take_settings(browser, folder, out):
    """Take the forms of settings on a phone."""
    line = Line(str(folder / 'tunable')).plug()
    rows = folder / 'rows.yaml'
    rows.write_text(GAINS)
    with contextlib.ExitStack() as stack:
        stack.callback(line.unplug)
        stack.enter_context(running(program('simulator'), 'arduino', '--port', line.far,
                                    '--config', str(rows), '--announce'))
        bridge = Bridge(parameters={'arduino/port': line.near,
                                    'settings': {'arduino': {'kp': 40.0, 'ki': 200.0}}})
        stack.callback(bridge.end)
        panel = panel_helpers.Panel('--control')
        stack.callback(panel.end)
        browser.resize(*PHONE)
        browser.open(panel.url)
        browser.wait(lambda page: page.texts('.board-value') == ['40', '200', '0'],
                     'the board has them', 60)
        browser.script("[...document.querySelectorAll('.tabs button')]"
                       ".find((each) => each.textContent === 'Commands').click();"
                       "document.querySelector('[data-service*=ki]')"
                       ".scrollIntoView({block: 'center'})")
        browser.wait(lambda page: page.all('[data-service*=settings] button:enabled'), 'commands')
        save(browser.picture(), out / 'panel_settings.png')


def take_stamps(browser, folder, out):
    """Take the picture of stamps."""
    line = Line(str(folder / 'stamps')).plug()
    points = stamps_picture.measure(line)
    line.unplug()
    path = folder / 'stamps.html'
    path.write_text(stamps_picture.page(points))
    browser.open(path.as_uri())
    save(browser.picture('svg'), out / 'board_time.png')


def main():
    """Take all pictures."""
    out = Path(sys.argv[1])
    os.environ['ROS_MASTER_URI'] = f'http://localhost:{panel_helpers.free_port()}'
    os.environ['ROS_HOSTNAME'] = 'localhost'
    core = panel_helpers.Core()
    browser = Browser()
    with tempfile.TemporaryDirectory(prefix='pictures_') as folder:
        try:
            (out / 'diff_drive_square.svg').write_text(
                square_picture.picture(*square_picture.measure()))
            tuning_picture.make(out)
            take_stamps(browser, Path(folder), out)
            take_settings(browser, Path(folder), out)
            take_intact(browser, Path(folder), out)
            take_faulty(browser, Path(folder), out)
            take_rviz(out)
        finally:
            browser.quit()
            core.stop()


if __name__ == '__main__':
    main()
