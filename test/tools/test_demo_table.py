"""What the live table shows of a state, and what it finds missing; without ROS."""
import io
from types import SimpleNamespace as Message

import pytest
from serial_communication.tools.demo import table, topics
from serial_communication.tools.demo.table import LinkState, Screen, State

COUNTERS = {'port': '/dev/ttyS0', 'state': 'open', 'frames received': '1234567',
            'frames sent': '7654321', 'bytes received': '1', 'bytes sent': '2',
            'checksum errors': '3', 'framing errors': '4', 'reconnects': '5',
            'last frame age [s]': '0.004'}


def busy(**options) -> State:
    """A state in which everything works and all counters are long."""
    state = State(setup='. /home/somebody/serial_communication/build/devel/setup.bash', **options)
    state.elapsed = 4000.0
    for each in state.topics:
        if not each.topic.optional:
            each.count, each.rate, each.words = 100000, 99.97, 'some value ' * 10
    state.links = {
        'bus': LinkState(0, 'ready', dict(COUNTERS, **{
            'timeouts': '2', 'round trip p50 [ms]': '1.25', 'round trip max [ms]': '9.00'})),
        'arduino': LinkState(1, 'open, the board is silent', dict(COUNTERS, **{
            'heartbeats sent': '99999', 'heartbeat max gap [ms]': '10.40'})),
        'mcu': LinkState(2, 'closed: no such file', dict(COUNTERS, **{'frames lost': '6'}))}
    for call in state.calls.values():
        call.words, call.succeeded = 'up 20 mm: done', 1
    state.commands = '~speed 300, ~steering 1500, ~led left'
    return state


def text(state, *size):
    return '\n'.join(line.text for line in table.layout(state, *size))


@pytest.mark.parametrize('size', [(80, 24), (80, 30), (132, 50), (40, 10), (20, 3), (1, 1)])
@pytest.mark.parametrize('state', [State(), busy()], ids=['nothing yet', 'busy'])
def test_it_fits(state, size):
    lines = table.layout(state, *size)
    assert len(lines) <= size[1]
    assert max(len(line.text) for line in lines) <= size[0]
    assert all('\n' not in line.text for line in lines)


@pytest.mark.parametrize('state', [State(), busy()], ids=['nothing yet', 'busy'])
def test_on_80_by_24_nothing_is_left_out(state):
    shown = text(state, 80, 24)
    for each in state.topics:
        if not each.topic.optional:
            assert each.topic.name.split('/')[-1] in shown
    for name in ('bus', 'arduino', 'mcu', 'lift', 'gimbal'):
        assert any(line.startswith(name + ' ') for line in shown.splitlines())


def test_states_of_the_links_and_their_counters():
    lines = table.layout(busy(), 200, 50)
    by_link = {line.text.split()[0]: line for line in lines if line.text}
    assert by_link['bus'].style == 'good'
    assert by_link['bus'].text == (
        'bus     OK    ready, in 1234567, out 7654321, bad 7, timeouts 2, round trip 1.25 ms, '
        'reconnects 5')
    assert by_link['arduino'].style == 'warn'
    assert 'heartbeats 99999, max gap 10.40 ms' in by_link['arduino'].text
    assert by_link['mcu'].style == 'bad'
    assert 'ERROR closed: no such file' in by_link['mcu'].text and 'lost 6' in by_link['mcu'].text


def test_rates():
    state = State()
    imu = state.topics[1]
    for second in range(10):
        imu.measure(float(second))
        imu.count += 100
    assert imu.rate == pytest.approx(100.0)
    for second in range(10, 20):
        imu.measure(float(second))
    assert imu.rate == 0.0
    assert 'paused' in text(state, 80, 50)
    latched = state.topics[3]
    latched.count = 1
    latched.measure(0.0)
    assert '~imu/calibrating              once' in text(state, 80, 50)


def test_adc_boards_are_shown_where_there_is_one():
    state = busy()
    assert 'adc_status' not in text(state, 80, 50)
    adc = next(each for each in state.topics if each.topic.optional)
    adc.count = 1
    assert 'mcu/adc_status' in text(state, 80, 50)


def test_links_that_are_off_are_left_out():
    state = State(boards='real', links=('bus',), moves=False)
    shown = text(state, 80, 50)
    assert '~environment' in shown and '~imu' not in shown and 'mcu' not in shown
    assert 'none: real boards are only looked at' in shown
    assert not state.calls


def test_what_is_missing():
    assert busy().missing() == []
    state = busy()
    state.topics[1].count = 0
    state.calls['lift'].succeeded = 0
    state.calls['lift'].words = 'up 20 mm: no answer'
    assert state.missing() == ['no data on ~imu',
                               'no successful answer from lift: up 20 mm: no answer']
    assert len(State().missing()) == len(State().topics) - 1 + 2
    # Real boards that are only looked at need not move.
    assert not any('answer' in each for each in State(moves=False).missing())


def test_values_in_words():
    words = {each.name: each.words for each in topics.TOPICS}
    level = Message(x=0.0, y=0.0, z=0.7071068, w=0.7071068)
    assert words['mcu/imu'](Message(orientation=level)) == 'rpy 0.0 0.0 90.0 deg'
    for metres, said in ((float('nan'), 'no reading'), (float('inf'), 'farther than 2.00 m'),
                         (float('-inf'), 'nearer than 0.03 m'), (1.2345, '1.234 m')):
        assert words['mcu/range_1'](Message(range=metres, min_range=0.03, max_range=2.0)) == said
    assert words['serial_msg'](Message(link='bus', direction=1, text='lift up 20 mm', error='')) \
        == 'bus sent lift up 20 mm'
    assert words['mcu/status'](Message(connected=False, last_frame_age_sec=3.0)) \
        == 'silent for 3.0 s'


class Terminal(io.StringIO):
    """Says that it is one."""

    def isatty(self):
        return True


def test_a_terminal_is_redrawn_in_place_and_given_back(monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    monkeypatch.setenv('LINES', '24')
    out = Terminal()
    screen = Screen(out)
    screen.draw(busy())
    assert out.getvalue().count('\033[2J') == 1
    before = len(out.getvalue())
    screen.draw(busy())
    redraw = out.getvalue()[before:]
    assert redraw.startswith('\033[H') and '\033[2J' not in redraw
    assert redraw.count('\n') <= 23     # or it would scroll
    screen.close(busy())
    assert out.getvalue().endswith('\033[?25h\r\n')


def test_elsewhere_there_are_plain_lines_now_and_then():
    out = io.StringIO()
    screen = Screen(out)
    for _ in range(10):
        screen.draw(busy())
    screen.close(busy())
    assert '\033' not in out.getvalue()
    assert out.getvalue().count('17 of 17 topics carry data') == 2
    assert 'topic ' in out.getvalue()
