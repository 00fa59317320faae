"""The table of a bridge and of the demo, at every size; without ROS."""
import io
import re

import pytest
from serial_communication.tools.demo.state import Demo
from serial_communication.tools.watch import table
from serial_communication.tools.watch.calls import Verdict
from serial_communication.tools.watch.state import LinkState
from serial_communication.tools.watch.table import Screen

NOW = 4000.0
SETUP = '. /home/somebody/serial_communication/build/devel/setup.bash'
COUNTERS = {'port': '/dev/ttyS0', 'state': 'open', 'frames received': '1234567',
            'frames sent': '7654321', 'bytes received': '1', 'bytes sent': '2',
            'checksum errors': '3', 'framing errors': '4', 'reconnects': '5',
            'last frame age [s]': '0.004'}
SIZES = [(200, 60), (132, 50), (80, 30), (80, 24), (60, 15), (40, 10), (20, 3), (1, 1)]


def running(state: Demo) -> Demo:
    """The same state after the master has reported the bridge."""
    state.bridge.master_answered(True, NOW)
    return state


def idle(**options) -> Demo:
    return running(Demo(**options))


def busy(**options) -> Demo:
    """A state in which every topic carries data and all counters are long."""
    state = running(Demo(**{'setup': SETUP, **options}))
    for each in state.bridge.topics:
        if not each.topic.optional:
            each.count, each.rate, each.words, each.last_at = 100000, 99.97, 'value ' * 10, NOW
    for name, link in {
            'bus': LinkState(0, 'ready', dict(COUNTERS, **{
                'timeouts': '2', 'round trip p50 [ms]': '1.25', 'round trip max [ms]': '9.00'})),
            'arduino': LinkState(1, 'open, the board is silent', dict(COUNTERS, **{
                'heartbeats sent': '99999', 'heartbeat gap [ms]': '10.40',
                'heartbeat max gap [ms]': '99.52'})),
            'mcu': LinkState(2, 'closed: no such file', dict(COUNTERS, **{
                'frames lost': '6', 'read delay p50 [ms]': '8.31',
                'read delay max [ms]': '16.40'}))}.items():
        state.bridge.set_link(name, link._replace(at=NOW))
    for calls in state.calls.values():
        calls.answered('up 20 mm', Verdict.DONE, '', 0.4)
    state.driving = '~speed 300, ~steering 1500, ~led left'
    return state


def lines(state, width=80, height=24, now=NOW):
    return table.layout(state.bridge, state.heading(NOW), now, width, height)


def text(state, *size, **more):
    return '\n'.join(line.text for line in lines(state, *size, **more))


@pytest.mark.parametrize('size', SIZES)
@pytest.mark.parametrize('state', [idle(), busy(), busy(setup='. ' + 'x' * 250)],
                         ids=['nothing yet', 'busy', 'long path'])
def test_the_table_fits_the_terminal(state, size):
    width, height = size
    shown = lines(state, *size)
    assert sum(line.rows(width) for line in shown) <= height
    assert max(len(line.text) for line in shown if not line.whole) <= width
    assert all('\n' not in line.text for line in shown)


@pytest.mark.parametrize('size', SIZES[:5])
def test_links_and_calls_come_first_and_are_never_left_out(size):
    shown = text(busy(), *size).splitlines()
    names = ['bus', 'arduino', 'mcu', 'lift', 'gimbal', 'car']
    places = [next(at for at, line in enumerate(shown) if line.startswith(name + ' '))
              for name in names]
    assert places == sorted(places)
    assert places[-1] < next(at for at, line in enumerate(shown) if line.startswith('serial_msg'))


def test_a_link_shows_its_status_and_counters():
    by_link = {line.text.split()[0]: line for line in lines(busy(), 200, 60) if line.text}
    assert by_link['bus'].style == 'good'
    assert by_link['bus'].text == (
        'bus     OK    ready, errors 7 (3 checksum, 4 framing), in 1234567, out 7654321, '
        'timeouts 2, round trip 1.25 ms, reconnects 5')
    assert by_link['arduino'].style == 'warn'
    assert 'heartbeat gap 10.40 ms' in by_link['arduino'].text
    assert by_link['mcu'].style == 'bad'
    assert 'ERROR closed: no such file' in by_link['mcu'].text and 'lost 6' in by_link['mcu'].text
    assert 'read delay 8.31 ms' in by_link['mcu'].text


def test_a_stale_topic_shows_its_age_and_a_latched_one_does_not():
    state = busy()
    voltage = state.bridge.topic('~voltage')
    voltage.last_at = NOW - 2.0
    assert re.search('^~voltage +100.0 Hz  value', text(state, 80, 50), re.M)
    voltage.last_at = NOW - 3.5
    line = next(line for line in lines(state, 80, 50) if line.text.startswith('~voltage'))
    assert re.match('~voltage +3.5 s old  value', line.text)
    assert line.style == 'warn'
    latched = state.bridge.topic('~imu/calibrating')
    latched.count, latched.rate, latched.last_at = 1, 0.0, 0.0
    assert re.search('^~imu/calibrating +once  value', text(state, 80, 50), re.M)


class Terminal(io.StringIO):
    """An output that says it is a terminal."""

    def isatty(self):
        return True


def draw(screen, state):
    screen.draw(state.bridge, state.heading(NOW), NOW)


def test_a_terminal_is_redrawn_in_place_and_restored(monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    monkeypatch.setenv('LINES', '24')
    out = Terminal()
    screen = Screen(out)
    draw(screen, busy())
    assert out.getvalue().count('\033[2J') == 1
    before = len(out.getvalue())
    draw(screen, busy())
    redraw = out.getvalue()[before:]
    assert redraw.startswith('\033[H') and '\033[2J' not in redraw
    assert redraw.count('\n') <= 23     # or it would scroll
    screen.close(busy().bridge, busy().heading(NOW), NOW)
    assert out.getvalue().endswith('\033[?25h\r\n')
