"""The state of a board's settings: what is sent when, and what counts as confirmed."""
import logging
from dataclasses import replace

import pytest

from board_rows import car_settings

from serial_communication.framing.rows import BOARD, SettingMessage
from serial_communication.framing.stream import Decoder
from serial_communication.link.settings import BoardSettings
from serial_communication.link.sparing_log import SparingLog

ROWS = {'kp': {'setting': 1, 'layout': '<f', 'minimum': 0, 'maximum': 10},
        'ramp': {'setting': 2, 'layout': '<H', 'unit': 'ms'},
        'on': {'setting': 3, 'layout': '<?'}}


class Rig:
    """Settings on a line: what is sent, and what the board reports."""

    def __init__(self, caplog=None, rows=ROWS, announced=False):
        self.now = 100.0
        self.sent = []            # (time, number, value)
        self.woken = 0
        self.is_current = False
        log = SparingLog('arduino', logging.getLogger('rig'))
        self.decoder = Decoder()
        self.settings = BoardSettings(log, self.decoder, self._wake)
        self.remove = {row.name: self.settings.add(replace(
            row, origin=BOARD) if announced else row) for row in car_settings(rows)}

    def _wake(self):
        self.woken += 1

    def report(self, number, value):
        """The board reports a value."""
        kind = self.decoder.messages[bytes((number,))]
        self.settings.received(kind(number, value), self.is_current)

    def step(self, seconds=0.0):
        """Let so much time pass, calling `send` when it asks for it."""
        end = self.now + seconds
        while True:
            messages, due = self.settings.send(self.now, self.is_current)
            self.sent += [(round(self.now, 3), *message.unpack(message.pack()))
                          for message in messages]
            if due is None or due > end:
                self.now = end
                return
            self.now = due

    def shown(self, name='kp'):
        state = self.settings.shown()[name]
        return state.value, state.wanted, state.is_settled


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


def test_a_value_that_the_board_limits_is_known_after_three_answers(rig):
    rig.report(1, 1.0)
    rig.settings.want('kp', 9.0)
    for _ in range(3):
        assert not rig.shown()[2]
        rig.step(0.0 if len(rig.sent) < 1 else 0.2)
        rig.report(1, 5.0)
    assert rig.shown() == (5.0, 9.0, True)
    assert rig.settings.values()[1] == ('settings unconfirmed', 'kp=9')
    rig.settings.want('kp', 5.0)
    rig.step()
    rig.report(1, 5.0)
    assert rig.shown() == (5.0, 5.0, True) and rig.settings.values()[1][1] == ''


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


def test_a_value_that_is_not_allowed_is_refused_with_a_warning(rig, caplog):
    rig.settings.want('kp', 11)
    assert rig.shown() == (None, None, True)
    assert caplog.messages == ['arduino: the setting kp cannot be 11: it may be a number from 0 to '
                               '10']


def test_waiting_ends_with_the_answer_or_the_time(rig):
    rig.settings.want('kp', 2.0)
    rig.settings.wait(['kp', 'gone'], 0.01)
    rig.step()
    rig.report(1, 2.0)
    rig.settings.wait(['kp'], 1e6)
