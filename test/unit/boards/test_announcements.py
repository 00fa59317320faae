"""What links do with announcements; the judge decides what is sent to which board (test/sim)."""
import pytest

from steps import Steps
from serial_communication.boards.arduino import wire as arduino
from links import ArduinoLink
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus import polls
from serial_communication.boards.bus.call import Call
from serial_communication.boards.mcu import wire as mcu
from links import McuLink
from serial_communication.framing.announcement import Assembly
from serial_communication.simulation.announcing import chunks_of
from serial_communication.link.session import Refused
from serial_communication.link.outcome import TIMEOUT, Outcome
from serial_communication.link.sparing_log import SparingLog

TEXT = b'firmware: nano_car 1.1.0\nforce: {type: 32, ros_type: std_msgs/Float32}\n'
OTHER = b'bumper: {type: 33, ros_type: std_msgs/Bool}\n'
TICKS = arduino.encode(arduino.Ticks(1))


def packets(text, size=20):
    """The chunks as the model car sends them."""
    return [arduino.encode(chunk) for chunk in chunks_of(text, size)]


class Force(arduino.Ticks):
    """The message of the announced row `force`."""

    __slots__ = ()
    TYPE = 32
    ANNOUNCED = True


@pytest.fixture
def car(logger):
    """A link to the model car, with what it has announced and sent."""
    got, texts = [], []
    steps = Steps(ArduinoLink, logger=logger, on_message=lambda message, stamp: got.append(message))
    steps.got, steps.texts = got, texts
    steps.link.session.announcement.on_text = texts.append
    return steps.run(0.1)


def test_the_car_announces_a_text_once_and_a_changed_one_again(car):
    car.give(b''.join(packets(TEXT) * 2 + packets(OTHER)[:1] + packets(TEXT)) + TICKS)
    assert car.texts == [TEXT] and car.got == [arduino.Ticks(1)]
    car.give(b''.join(packets(OTHER)))
    assert car.texts == [TEXT, OTHER] and not any(car.link.session.errors.values())


def test_announced_rows_are_used_only_after_this_board_has_announced_them(car):
    """After the port was opened, another board may be behind it."""
    force, link = arduino.encode(Force(7)), car.link
    link.session.decoder.add_message(Force)
    car.give(b''.join(packets(TEXT)))
    assert not link.session.announcement.is_current       # until its rows are in use
    link.session.announcement.use(TEXT, 'nano_car 1.1.0', ['force'])
    car.give(force + TICKS)
    assert car.got == [Force(7), arduino.Ticks(1)]
    car.unplug().plug().give(force * 3 + TICKS)
    assert car.got[2:] == [arduino.Ticks(1)]
    with pytest.raises(Refused, match='has not announced this'):
        link.command(Force(2))
    car.give(packets(TEXT)[2] + force)
    assert car.got[3:] == [Force(7)]
    values = dict(link.report(car.port.time).values)
    assert (values['held back'], values['firmware'], values['announced']) == (
        3, 'nano_car 1.1.0', 'force')
    car.give(b''.join(packets(OTHER)) + force + TICKS)
    assert car.got[4:] == [arduino.Ticks(1)], 'the board announces something else now'


def test_chunks_of_the_sensor_board_count_in_seq_and_are_no_sign_of_life(logger):
    silences, texts = [], []
    sensors = Steps(McuLink, timeout=0.1, logger=logger,
                    on_silence=lambda *silence: silences.append(silence))
    sensors.link.session.announcement.on_text = texts.append
    sensors.run(0.05).give(b''.join(mcu.encode(chunk, seq + 7) for seq, chunk in
                                    enumerate(chunks_of(TEXT, 20))), 1.0)
    assert texts == [TEXT] and not sensors.link.session.talks(0.0)
    assert {kind for kind, _, _ in silences} == {None} and sensors.port.wrote == []


# -- the bus ---------------------------------------------------------------------------------------

class Questions:
    """A question whose answers and times the test sets."""

    def __init__(self, log=None):
        self.asked = []
        self.question = polls.AnnouncementReader(self._ask, Assembly(), log)
        self.question.begin(0.0)

    def _ask(self, request, function, now, on_success):
        self.asked.append(Call(request, function, 0.5, 1, 0.0))
        return self.asked[-1]


@pytest.mark.parametrize('outcome', [
    Outcome(TIMEOUT, 'no reply'), Outcome(bus.INVALID, 'not synchronised', bus.NOT_SYNCHRONISED)],
    ids=('none', 'not synchronised'))
def test_the_pauses_between_questions_grow(outcome, log):
    questions, asked_at = Questions(log), []
    for tenth in range(1000):
        questions.question.tick(tenth / 10)
        if len(questions.asked) > len(asked_at):
            asked_at.append(tenth / 10)
            questions.asked[-1].finish(outcome)
            questions.question.tick(tenth / 10)
    assert asked_at == pytest.approx([0.0, 0.5, 1.5, 3.5, 7.5, 15.5])
    questions.question.begin(100.0)       # a board that always replies that, and then SYNC
    assert questions.question.tick(107.9) is None and len(questions.asked) == 6
    questions.question.tick(108.0)
    assert len(questions.asked) == 7


def answer(questions, chunks, most=1000):
    """Answer questions from these chunks until a text is known; return it."""
    for at in range(most):
        text = questions.question.tick(at / 10)
        if text is not None:
            return text
        call = questions.asked[-1]
        if call.outcome is None:
            index, = call.request.data
            call.finish(Outcome(bus.OK, '', 0,
                                chunks[index].pack() if index < len(chunks) else b''))
    return None


@pytest.mark.parametrize('outcome', [
    Outcome(bus.ERROR, 'x', 0x8001), Outcome(bus.INVALID, 'x', 0x20)], ids=('error', 'invalid'))
def test_a_refusal_means_that_nothing_is_announced(log, outcome):
    questions = Questions(log)
    questions.question.tick(0.0)
    questions.asked[0].finish(outcome)
    assert questions.question.tick(0.1) == b'' and len(questions.asked) == 1


def test_a_bus_board_is_asked_for_each_chunk_once(log):
    questions = Questions(log)
    assert answer(questions, chunks_of(TEXT, 20)) == TEXT
    assert [call.request.data for call in questions.asked] == [
        bytes((index,)) for index in range(len(chunks_of(TEXT, 20)))]
    assert bus.encode_request(questions.asked[0].request) == bytes.fromhex('a50155ff000e')


@pytest.fixture
def log(logger):
    return SparingLog('bus', logger)
