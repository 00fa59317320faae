"""How often a setting is sent, and what its answer is; the judge decides the rest (test/sim)."""
import logging

import pytest
from board_rows import car_settings

from serial_communication.framing.stream import Decoder
from serial_communication.link.settings import BoardSettings
from serial_communication.link.sparing_log import SparingLog


class Kp(BoardSettings):
    """The setting `kp` of a board: what is sent, and what the board reports."""

    def __init__(self):
        decoder = Decoder()
        super().__init__(SparingLog('arduino', logging.getLogger('settings')), decoder,
                         lambda: None)
        self.now, self.times = 0.0, []
        self.add(*car_settings({'kp': {
            'setting': 1, 'layout': '<f', 'minimum': 0, 'maximum': 10}}))
        self._message, = decoder.messages.values()

    def report(self, value):
        self.received(self._message(1, value), True)

    def run(self, end):
        """Send what is due until then."""
        due = self.now
        while due is not None and due <= end:
            self.now = due
            messages, due = self.send(self.now, True)
            self.times += [round(self.now, 3) for _ in messages]
        self.now = end

    def state(self):
        state = self.shown()['kp']
        return state.value, state.wanted, state.is_settled


@pytest.fixture
def kp():
    return Kp()


def test_it_is_sent_again_five_times_quickly_and_then_each_second_with_one_warning(kp, caplog):
    kp.run(0.0)
    assert kp.times == []
    kp.want('kp', 2)
    kp.run(5.9)
    assert kp.times == [0, 0.2, 0.4, 0.6, 0.8, 1.8, 2.8, 3.8, 4.8, 5.8]
    assert len(caplog.messages) == 1
    assert kp.values() == [('settings', 'kp=?'), ('settings unconfirmed', 'kp=2')]
    kp.report(2.0)
    kp.run(60.0)
    assert len(kp.times) == 10 and kp.state() == (2.0, 2.0, True)
    kp.reset()      # the board may be another one
    kp.run(60.0)
    assert len(kp.times) == 11 and kp.state() == (None, 2.0, False)


def test_a_value_that_the_board_limits_is_known_after_three_answers(kp):
    kp.want('kp', 9.0)
    for tries in range(3):
        assert not kp.state()[2]
        kp.run(tries * 0.2)
        kp.report(5.0)
    assert kp.state() == (5.0, 9.0, True)
    assert kp.values()[1] == ('settings unconfirmed', 'kp=9')


def test_a_value_that_is_not_allowed_is_refused_with_a_warning(kp, caplog):
    kp.want('kp', 11)
    assert kp.state() == (None, None, True) and len(caplog.messages) == 1


def test_waiting_ends_with_the_answer(kp):
    kp.want('kp', 2.0)
    kp.wait(['kp', 'gone'], 0.01)
    kp.run(0.0)
    kp.report(2.0)
    kp.wait(['kp'], 1e6)
