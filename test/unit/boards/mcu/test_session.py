"""What the sensor board's frames mean: lost ones, and silence."""
import logging

import pytest
from board_rows import mcu_messages

from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.session import SensorSession
from serial_communication.link.sparing_log import SparingLog
from serial_communication.simulation.announcing import chunks_of

STATUS = mcu.SensorStatus(100, 200, 1.0, 2.0, 3.0)
ADC = mcu.AdcStatus(1, 2, 3, 4, 5, 6)


class Session(SensorSession):
    """A session whose time the test sets, in s from its begin, with a timeout of 0.2 s."""

    def __init__(self):
        self.time, self.got, self.silences = 0.0, [], []
        super().__init__(SparingLog('mcu', logging.getLogger('mcu')), 0.2,
                         lambda *status: self.got.append(status),
                         lambda *silence: self.silences.append((*silence, self.time)),
                         now=lambda: self.time)

    def receive(self, message, seq):
        frame, = self.decoder.feed(mcu.encode(message, seq), 'stamp')
        self.received(frame, self.time)

    def wait(self, end):
        """The silences that are reported until then, with the time of each."""
        del self.silences[:]
        while self.time < end:
            self.time = min(self.idle(self.time), end)
            self.idle(self.time)
        return [(kind, seq, pytest.approx(age), pytest.approx(time))
                for kind, seq, age, time in self.silences]


@pytest.mark.parametrize('seqs, lost', [
    ((1, 2, 3), 0), ((1, 3), 1), ((1, 11, 12), 9), ((254, 255, 0, 1), 0), ((250, 4), 9),
    ((255, 1), 1), ((200, 0), 55), ((9,), 0), ((1, 2, 2, 2, 3), 0)])
def test_lost_frames_are_counted_over_the_modulo_and_a_doubled_one_is_no_gap(seqs, lost):
    session = Session()
    for seq in seqs:
        session.receive(STATUS, seq)
    assert session.got == [(STATUS, seq, 'stamp') for seq in seqs]
    assert dict(session.values())['frames lost'] == lost


def test_silence_is_reported_once_a_second_for_each_message_with_its_age():
    """Otherwise the last values of one would look current while another is received."""
    session = Session()
    assert session.wait(1.5) == [(None, 0, 0.2, 0.2), (None, 0, 1.2, 1.2)]
    assert not session.talks(session.time)
    session.receive(STATUS, 9)
    found = []
    for tenth in range(20):
        session.receive(ADC, 10 + tenth)
        found += session.wait(1.6 + tenth / 10)
        assert session.talks(session.time)
    assert found == [(mcu.SensorStatus, 9, 0.2, 1.7), (mcu.SensorStatus, 9, 1.2, 2.7)]
    assert session.wait(4.0) == [(mcu.AdcStatus, 29, 0.2, 3.6), (mcu.SensorStatus, 9, 2.2, 3.7)]


def test_an_announcement_is_no_sign_of_life():
    session, texts = Session(), []
    session.announcement.on_text = texts.append
    text = b'firmware: sensors 1.0\n'
    for seq, chunk in enumerate(chunks_of(text, 20)):
        session.receive(chunk, seq)
    assert texts == [text] and not session.talks(0.0)
    assert session.wait(0.3) == [(None, 0, 0.2, 0.2)]


def test_values_of_a_row_that_the_board_has_not_announced_are_held_back_and_counted():
    session = Session()
    row, = mcu_messages({'force': {
        'type': 32, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data']}})
    message = row.message
    message.ANNOUNCED = True
    session.decoder.add_message(message)
    session.receive(message(1), 1)
    assert session.got == [] and session.announcement.held_back == 1
