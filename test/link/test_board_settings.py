"""The state of a board's settings: what is sent when, and what counts as confirmed."""
import logging
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from board_rows import car_settings

from serial_communication.framing.rows import BOARD
from serial_communication.framing.settings import SettingMessage
from serial_communication.link.outcome import Refused
from serial_communication.link.settings import BoardSettings
from serial_communication.link.sparing_log import SparingLog

ROWS = {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0, 'maximum': 10},
        'ramp': {'setting': 2, 'layout': '<H', 'unit': 'ms'},
        'on': {'setting': 3, 'layout': '<?'}}
DEFAULTS = {1: 1.0, 2: 100, 3: False}
MANY = {f's{number}': {'setting': number, 'layout': '<B'} for number in range(60)}


class Rig:
    """Settings on a line: what is sent, and what the board reports."""

    def __init__(self, caplog=None, rows=ROWS, announced=False):
        self.now = 100.0
        self.sent = []            # (time, number, value)
        self.kinds = []
        self.woken = 0
        self.refuses = self.is_current = False
        log = SparingLog('arduino', logging.getLogger('rig'))
        self.settings = BoardSettings(log, self.kinds.append, self._wake, lambda: self.now)
        self.remove = {row.name: self.settings.add(replace(
            row, origin=BOARD) if announced else row) for row in car_settings(rows)}

    def _wake(self):
        self.woken += 1

    def _write(self, message):
        if self.refuses:
            raise Refused('not now', 'calibrating')
        self.sent.append((round(self.now, 3), *self.kinds[-1].unpack(message.pack())))

    def report(self, number, value):
        """The board reports a value."""
        self.settings.received(self.kinds[-1](number, value), self.is_current)

    def step(self, seconds=0.0):
        """Let so much time pass, calling `send` when it asks for it."""
        end = self.now + seconds
        while True:
            due = self.settings.send(self.now, self._write, self.is_current)
            if due is None or due > end:
                self.now = end
                return
            self.now = due

    def shown(self, name='kp'):
        return self.settings.shown()[name]

    @property
    def is_over_20_a_second(self):
        """Whether over 20 frames were sent in any second."""
        times = [at for at, *_ in self.sent]
        return any(later - at < 0.999 for at, later in zip(times, times[20:]))


@pytest.fixture
def rig(caplog):
    return Rig()


def test_nothing_is_sent_while_nothing_is_wanted(rig):
    rig.step(5)
    rig.report(1, 1.5)
    rig.step(5)
    assert rig.sent == [] and rig.shown() == (1.5, None, True)
    assert rig.settings.values() == [('settings', 'kp=1.5, on=?, ramp=?'),
                                     ('settings unconfirmed', '')]


def test_no_rows_are_nothing():
    rig = Rig(rows={})
    rig.step(5)
    rig.settings.received(SettingMessage(1, (0, 0)), True)
    assert rig.sent == [] and rig.settings.values() == []


def test_a_wanted_value_is_sent_at_once_and_once_if_the_board_answers(rig):
    rig.settings.want('kp', 2)
    assert rig.woken and rig.shown() == (None, 2.0, False)
    rig.step()
    assert rig.sent == [(100.0, 1, 2.0)]
    rig.report(1, 2.0)
    rig.step(30)
    assert len(rig.sent) == 1 and rig.shown() == (2.0, 2.0, True)
    rig.settings.want('kp', 2)
    rig.step(5)
    assert len(rig.sent) == 1


def test_it_is_sent_again_five_times_quickly_and_then_each_second_with_one_warning(rig, caplog):
    rig.settings.want('ramp', 250)
    rig.step(5.9)
    assert [round(at - 100, 3) for at, *_ in rig.sent] == [
        0, 0.2, 0.4, 0.6, 0.8, 1.8, 2.8, 3.8, 4.8, 5.8]
    warning, = caplog.messages
    assert 'has not confirmed ramp = 250' in warning and 'silent' in warning
    assert rig.settings.values()[1] == ('settings unconfirmed', 'ramp=250')


def test_a_board_that_starts_again_gets_all_wanted_values_as_soon_as_it_reports_one(rig):
    for name, value in (('kp', 2.0), ('ramp', 250)):
        rig.settings.want(name, value)
    rig.step()
    rig.report(1, 2.0)
    rig.report(2, 250)
    rig.report(3, False)
    rig.step(1)
    rig.sent.clear()
    rig.report(2, 100)
    assert rig.settings.values()[1] == ('settings unconfirmed', 'kp=2, ramp=250')
    rig.step()
    assert sorted(each[1:] for each in rig.sent) == [(1, 2.0), (2, 250)]


def test_a_report_from_before_the_first_try_confirms_nothing(rig):
    rig.report(1, 2.0)
    rig.settings.want('kp', 3.0)
    rig.step()
    rig.settings.want('kp', 2.0)
    rig.report(1, 2.0)
    assert not rig.shown()[2]
    rig.step()
    rig.report(1, 3.0)
    assert not rig.shown()[2]
    rig.report(1, 2.0)
    assert rig.shown() == (2.0, 2.0, True) and [value for *_, value in rig.sent] == [3.0, 2.0]


def test_a_value_that_the_board_limits_is_known_after_three_answers(rig):
    rig.report(1, 1.0)
    rig.settings.want('kp', 9.0)
    for count in range(3):
        assert not rig.shown()[2]
        rig.step()
        rig.report(1, 5.0)
        rig.report(1, 5.0)         # its reports in turn tell nothing about a try
        rig.step(0.2 if count < 2 else 0.0)
    assert rig.shown() == (5.0, 9.0, True)
    assert rig.settings.values()[1] == ('settings unconfirmed', 'kp=9')
    rig.settings.want('kp', 5.0)
    rig.step()
    rig.report(1, 5.0)
    assert rig.shown() == (5.0, 5.0, True) and rig.settings.values()[1][1] == ''


def test_nothing_is_counted_as_a_try_while_it_cannot_be_sent(rig, caplog):
    rig.refuses = True
    rig.settings.want('kp', 2.0)
    rig.step(60)
    assert rig.sent == [] and caplog.messages == []
    rig.refuses = False
    rig.step(1.1)
    begun = rig.sent[0][0]
    assert begun <= 160.2
    assert [round(at - begun, 3) for at, *_ in rig.sent] == [0, 0.2, 0.4, 0.6, 0.8]


def test_announced_rows_are_sent_and_read_only_while_they_are_those_of_the_board():
    rig = Rig(announced=True)
    rig.settings.want('kp', 2.0)
    rig.report(1, 7.0)
    rig.step(10)
    assert rig.sent == [] and rig.shown() == (None, 2.0, False)
    rig.is_current = True
    rig.step()
    rig.report(1, 2.0)
    assert [each[1:] for each in rig.sent] == [(1, 2.0)] and rig.shown()[2]


def test_a_reopened_port_has_all_sent_again(rig):
    rig.settings.want('kp', 2.0)
    rig.step()
    rig.report(1, 2.0)
    rig.settings.reset()
    assert rig.shown() == (None, 2.0, False)
    rig.step()
    assert len(rig.sent) == 2


def test_a_row_that_goes_and_comes_again_keeps_its_wanted_value(rig):
    rig.settings.want('kp', 2.0)
    rig.remove['kp']()
    rig.step(5)
    assert rig.sent == [] and 'kp' not in rig.settings.shown()
    rig.settings.add(*car_settings({'kp': dict(ROWS['kp'], setting=9)}))
    rig.step()
    assert [each[1:] for each in rig.sent] == [(9, 2.0)]
    rig.remove['kp']()             # of the first one
    assert 'kp' in rig.settings.shown()


def test_a_value_that_is_not_allowed_is_refused_with_a_warning(rig, caplog):
    rig.settings.want('kp', 11)
    assert rig.shown() == (None, None, True)
    assert caplog.messages == ['arduino: the setting kp cannot be 11: it may be a number from 0 to '
                               '10']


def test_values_are_shown_with_all_digits():
    rig = Rig(rows={'count': {'setting': 1, 'layout': '<I'}, 'gain': {'setting': 2, 'layout': '<f'},
                    'on': {'setting': 3, 'layout': '<?'}})
    for number, value in (1, 4294967295), (2, 0.12345679), (3, True):
        rig.report(number, value)
    assert rig.settings.values()[0][1] == 'count=4294967295, gain=0.12345679, on=true'


def test_a_setting_whose_row_has_just_gone_is_left_alone(rig):
    rig.remove['kp']()
    rig.settings.want('kp', 2.0)
    assert rig.settings.wanted == {} and rig.sent == []


def test_waiting_ends_with_the_answer_or_the_time(rig):
    rig.settings.want('kp', 2.0)
    rig.settings.wait(['kp', 'gone'], 0.01)
    rig.step()
    rig.report(1, 2.0)
    rig.settings.wait(['kp'], 1e6)


class Board:
    """A board that keeps settings, limits them and forgets them at a reset."""

    def __init__(self):
        self.reset()

    def reset(self):
        self.values = dict(DEFAULTS)

    def use(self, number, value):
        self.values[number] = min(value, 5.0) if number == 1 else value
        return number, self.values[number]


ACTIONS = st.one_of(
    st.tuples(st.just('want'), st.sampled_from([
        ('kp', 0.5), ('kp', 2.25), ('kp', 5.0), ('ramp', 0), ('ramp', 500), ('on', True)])),
    st.tuples(st.just('reset'), st.none()),
    st.tuples(st.just('report'), st.sampled_from([1, 2, 3])),
    st.tuples(st.just('pass'), st.sampled_from([0.0, 0.01, 0.3, 2.0])),
    st.tuples(st.just('lose'), st.sampled_from(['request', 'answer', 'nothing'])))


@settings(max_examples=150, deadline=None)
@given(st.lists(ACTIONS, max_size=40))
def test_whatever_is_lost_the_board_gets_what_is_wanted_and_never_over_20_frames_a_second(actions):
    rig, board, lost = Rig(), Board(), 'nothing'
    write, wanted = rig._write, {}

    def deliver(message):
        write(message)
        if lost != 'request':
            answer = board.use(*message)
            if lost != 'answer':
                answers.append(answer)

    rig._write, answers = deliver, []

    def answer():
        while answers:
            rig.report(*answers.pop(0))

    for action, argument in actions:
        if action == 'want':
            wanted[argument[0]] = argument[1]
            rig.settings.want(*argument)
        elif action == 'reset':
            board.reset()
        elif action == 'report':
            answer()
            rig.report(argument, board.values[argument])
        elif action == 'lose':
            lost = argument
        else:
            rig.step(argument)
            answer()
    lost = 'nothing'
    for _ in range(8):              # reports of all settings in turn
        for number in DEFAULTS:
            rig.step(0.2)
            answer()
            rig.report(number, board.values[number])
    numbers = {name: row['setting'] for name, row in ROWS.items()}
    assert {name: board.values[numbers[name]] for name in wanted} == wanted
    assert all(value == board.values[numbers[name]]
               for name, (value, _, _) in rig.settings.shown().items())
    assert rig.settings.values()[1][1] == ''
    assert not rig.is_over_20_a_second


def test_many_settings_are_limited_to_20_frames_a_second_and_all_are_sent():
    rig = Rig(rows=MANY)
    for name in MANY:
        rig.settings.want(name, 7)
    rig.step(6.0)
    assert {number for _, number, _ in rig.sent} == set(range(60))
    assert not rig.is_over_20_a_second


@pytest.mark.parametrize('stall', [0.0, 0.1, 0.45, 0.99])
def test_over_20_are_sent_in_no_second_in_which_the_thread_stalls(stall):
    rig = Rig(rows=MANY)
    for name in MANY:
        rig.settings.want(name, 7)
    for _ in range(3):
        before, rig.now = rig.now, rig.now + stall     # it stalls before the writes
        rig.settings.send(before, rig._write, False)
        for _ in range(200):
            rig.settings.send(rig.now, rig._write, False)
            rig.now += 0.01
    assert len(rig.sent) > 60 and not rig.is_over_20_a_second


def test_16_settings_are_all_sent_again_within_a_second_of_a_reset():
    rows = dict(list(MANY.items())[:16])
    rig = Rig(rows=rows)
    for name in rows:
        rig.settings.want(name, 7)
    rig.step(5)
    for number in range(16):
        rig.report(number, 7)
    assert rig.settings.values()[1][1] == ''
    rig.step(1)
    rig.sent.clear()
    rig.report(3, 0)
    rig.step(1)
    assert {number for _, number, _ in rig.sent} == set(range(16))


def test_a_setting_that_is_dragged_all_the_time_does_not_keep_another_from_the_line():
    rig = Rig()
    rig.settings.want('ramp', 250)
    for count in range(1000):      # in 5 s
        rig.settings.want('kp', count % 10)
        rig.settings.send(rig.now, rig._write, False)
        rig.now += 0.005
    numbers = [number for _, number, _ in rig.sent]
    assert numbers.count(2) >= 8 and numbers.count(1) >= 60


def test_the_value_of_a_limit_does_not_take_the_place_of_a_value_set_meanwhile(rig):
    rig.settings.want('kp', 9.0)
    rig.settings.want_instead('kp', 9.0, 5.0)
    assert rig.shown() == (None, 5.0, False)
    rig.settings.want('kp', 3.0)
    rig.settings.want_instead('kp', 9.0, 5.0)
    assert rig.shown() == (None, 3.0, False) and rig.settings.wanted == {'kp': 3.0}
    rig.remove['kp']()
    rig.settings.want_instead('kp', 3.0, 5.0)
    assert rig.settings.wanted == {'kp': 3.0}


def test_a_value_that_becomes_known_as_limited_is_a_change(rig):
    shown = []
    rig.settings.on_change = lambda: shown.append(rig.shown())
    rig.settings.want('kp', 9.0)
    for _ in range(3):
        rig.step()
        rig.report(1, 5.0)
        rig.step(0.2)
    assert shown[-1] == (5.0, 9.0, True)
    count = len(shown)
    rig.report(1, 5.0)
    assert len(shown) == count, 'nothing has changed'


def test_a_report_that_was_decoded_before_the_rows_changed_is_dropped():
    rig, early = Rig(rows={}), [SettingMessage(1, (0, 0, 128, 63))]
    for layout in '<f', '<I', '<f':
        rig.settings.add(*car_settings({'kp': {'setting': 1, 'layout': layout}}))
        for message in early:
            rig.settings.received(message, True)
        assert rig.shown() == (None, None, True) and rig.settings.values()[0][1] == 'kp=?'
        early.append(rig.kinds[-1](1, 7))
    rig.report(1, 1.5)
    assert rig.shown() == (1.5, None, True)
