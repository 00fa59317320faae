"""Announcements on the links, over real ttys."""
import time

import pytest

from fake_boards import BusBoard, CarBoard, until
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.link import ArduinoLink
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus import announcement
from serial_communication.boards.bus.call import Call
from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.link import McuLink
from serial_communication.framing.announcement import Assembly, Chunk, chunks_of
from serial_communication.link.link import Refused
from serial_communication.link.outcome import NOT_SENT, TIMEOUT, Outcome
from serial_communication.link.sparing_log import SparingLog
from serial_communication.transport.port import Port

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
def board(line, running):
    return running(CarBoard(line, [Force]))


@pytest.fixture
def car(line, board, logger, running):
    """A link to the model car, with what it has announced and sent."""
    got = []
    link = ArduinoLink(Port(line.path), on_message=lambda message, stamp: got.append(message),
                       logger=logger)
    link.texts, link.got = [], got
    link.announcement.on_text = link.texts.append
    running(link)
    until(lambda: link.heartbeats_sent)
    return link


def test_the_car_announces_a_text_once_and_a_changed_one_again(line, car):
    line.write(b''.join(packets(TEXT) * 2 + packets(OTHER)[:1] + packets(TEXT)) + TICKS)
    until(lambda: car.got)
    assert car.texts == [TEXT] and car.got == [arduino.Ticks(1)]
    line.write(b''.join(packets(OTHER)))
    until(lambda: len(car.texts) == 2)
    assert car.texts == [TEXT, OTHER]
    assert not any(car.decoder.errors.values())


def test_announced_rows_are_confirmed_again_after_a_reconnect(line, board, car):
    line.write(b''.join(packets(TEXT)))
    until(lambda: car.texts)
    assert not car.announcement.is_current       # until its rows are in use
    car.announcement.use(TEXT, '', [])
    assert car.announcement.is_current
    with board.unplugged():
        until(lambda: not car.port.is_open)
    until(lambda: car.port.is_open and car.connection.number == 2)
    assert not car.announcement.is_current
    line.write(packets(TEXT)[2])
    until(lambda: car.announcement.is_current)
    line.write(b''.join(packets(TEXT) + packets(OTHER)))
    until(lambda: len(car.texts) == 2)
    assert car.texts == [TEXT, OTHER] and not car.announcement.is_current


def test_values_of_announced_rows_are_held_back_until_this_board_has_announced_them(
        line, board, car):
    """After the port was opened, another board may be behind it."""
    force = arduino.encode(Force(7))
    car.decoder.add_message(Force)
    line.write(b''.join(packets(TEXT)))
    until(lambda: car.texts)
    car.announcement.use(TEXT, '', [])
    line.write(force + TICKS)
    until(lambda: car.got == [Force(7), arduino.Ticks(1)])
    del car.got[:]
    with board.unplugged():
        until(lambda: not car.port.is_open)
    until(lambda: car.port.is_open)
    line.write(force * 3 + TICKS)
    until(lambda: car.got)
    assert car.got == [arduino.Ticks(1)]
    line.write(packets(TEXT)[2] + force)
    until(lambda: len(car.got) == 2)
    assert car.got[1] == Force(7)
    car.announcement.rows = ['force']
    assert dict(car.report(time.monotonic()).values)['held back'] == 3
    line.write(b''.join(packets(OTHER)) + force + TICKS)
    until(lambda: len(car.got) == 3)
    assert car.got[2] == arduino.Ticks(1), 'the board announces something else now'


def test_values_of_the_sensor_boards_announced_rows_are_held_back(line, logger, running):
    got = []
    kind = type('Custom', (mcu.AdcStatus,), {'TYPE': 0x70, 'ANNOUNCED': True})
    link = McuLink(Port(line.path), timeout=60.0, logger=logger, messages=[kind],
                   on_status=lambda message, seq, stamp: got.append(seq))
    link.announcement.on_text = lambda text: link.announcement.use(text, '', [])
    running(link)
    until(lambda: link.port.is_open)
    line.write(mcu.encode(kind(*range(6)), 0) + mcu.encode(mcu.AdcStatus(*range(6)), 1))
    until(lambda: got)
    line.write(b''.join(mcu.encode(chunk, seq + 2) for seq, chunk in
                        enumerate(chunks_of(TEXT, 200))) + mcu.encode(kind(*range(6)), 3))
    until(lambda: len(got) == 2)
    assert got == [1, 3] and link.announcement.held_back == 1 and link.frames_lost == 0


def test_no_thread_can_send_an_announced_command_to_a_port_that_was_just_opened(
        line, board, car, monkeypatch):
    """It is tried in the moment when the port is open and no thread of the link has run yet."""
    line.write(b''.join(packets(TEXT)))
    until(lambda: car.texts)
    car.announcement.use(TEXT, '', [])
    car.command(Force(1))
    until(lambda: board.messages(Force) == [Force(1)])      # an unplugged line loses it
    tried = []
    really_open = car.port.open

    def open_and_command():
        really_open()
        with pytest.raises(Refused, match='has not announced it') as refused:
            car.command(Force(2))
        tried.append(refused)

    monkeypatch.setattr(car.port, 'open', open_and_command)
    with board.unplugged():
        until(lambda: not car.port.is_open)
    until(lambda: tried)
    heartbeats = car.heartbeats_sent
    until(lambda: car.heartbeats_sent > heartbeats + 3)
    assert board.messages(Force) == [Force(1)]


def test_a_text_that_is_too_long_is_refused_with_one_line(line, car, lines):
    line.write(b''.join(arduino.encode(Chunk(index, 12, 7, bytes(200))) for index in range(12)))
    until(lambda: lines('over 2048 bytes'))
    line.write(b''.join(packets(TEXT)))
    until(lambda: car.texts)
    assert car.texts == [TEXT] and len(lines('over 2048 bytes')) == 1


def test_diagnostics_have_the_keys_once_something_is_announced(car):
    keys = set(dict(car.report(time.monotonic()).values))
    assert not {'firmware', 'announced', 'held back'} & keys
    car.announcement.use(TEXT, 'nano_car 1.1.0', ['force', 'gripper'])
    values = dict(car.report(time.monotonic()).values)
    assert (values['firmware'], values['announced']) == ('nano_car 1.1.0', 'force, gripper')


def test_chunks_of_the_sensor_board_count_in_seq_and_are_no_sign_of_life(line, logger, running):
    silences = []
    link = McuLink(Port(line.path), timeout=0.1, logger=logger,
                   on_silence=lambda *silence: silences.append(silence))
    texts = []
    link.announcement.on_text = texts.append
    running(link)
    until(lambda: link.port.is_open)
    line.write(b''.join(mcu.encode(chunk, seq + 7) for seq, chunk in
                        enumerate(chunks_of(TEXT, 20))))
    until(lambda: texts and silences)
    assert texts == [TEXT] and link.frames_lost == 0 and link.silent
    assert {kind for kind, _, _ in silences} == {None}


def test_the_silence_of_classes_that_were_replaced_is_not_kept(line, logger, running):
    link = running(McuLink(Port(line.path), timeout=20.0, logger=logger))
    until(lambda: link.port.is_open)
    for seq in range(5):
        kind = type('Custom', (mcu.AdcStatus,), {'TYPE': 0x70})
        link.decoder.add_message(kind)
        line.write(mcu.encode(kind(*range(6)), seq))
        until(lambda seq=seq: link.frames_received == seq + 1)
        link.decoder.remove_message(kind)
    assert set(link._latest) == {None, 0x70}


def test_the_sensor_board_gets_no_byte(line, logger, running):
    link = McuLink(Port(line.path), logger=logger)
    texts = []
    link.announcement.on_text = texts.append
    running(link)
    until(lambda: link.port.is_open)
    line.write(b''.join(mcu.encode(chunk, seq) for seq, chunk in enumerate(chunks_of(TEXT, 20))))
    until(lambda: texts)
    assert line.read(0.1) == b''


# -- the bus ---------------------------------------------------------------------------------------

ASKED = bus.FUNCTION, 0xFF


class AnnouncingBoard(BusBoard):
    """Answers requests for its announcement from `chunks`."""

    chunks = []

    def usual(self, request):
        if request[:2] != ASKED or not self.chunks:
            return super().usual(request)
        index, = request.data
        return bus.Reply(bus.OK, self.chunks[index].pack() if index < len(self.chunks) else b'')

    def questions(self):
        """The indices that it was asked for."""
        return [request.data for request in self.requests() if request[:2] == ASKED]


@pytest.fixture
def bus_board(line, running):
    return running(AnnouncingBoard(line))


@pytest.fixture
def bus_link(line, logger, running, bus_board):
    # No question is repeated since this machine is slow, unless a test waits for that.
    def start(announcements=True, reply_timeout=5.0, **settings):
        link = BusLink(Port(line.path), BusSettings(
            reply_timeout=reply_timeout, environment_period=0.05, announcements=announcements,
            **settings), logger=logger)
        link.texts = []
        link.announcement.on_text = link.texts.append
        return running(link)
    return start


def test_a_bus_board_is_asked_only_if_the_parameter_says_so(bus_board, bus_link):
    bus_board.chunks = chunks_of(TEXT, 20)
    bus_link(announcements=False)
    until(lambda: len(bus_board.executed) > 5)
    assert bus_board.questions() == [] and set(bus_board.executed) == {bus.ENVIRONMENT_REQUEST}


def test_a_bus_board_is_asked_for_each_chunk_once_a_connection_after_sync(bus_board, bus_link):
    bus_board.chunks = chunks_of(TEXT, 20)
    link = bus_link()
    until(lambda: link.texts)
    environment = bus_board.executed.count(bus.ENVIRONMENT_REQUEST)
    until(lambda: bus_board.executed.count(bus.ENVIRONMENT_REQUEST) > environment + 3)
    assert link.texts == [TEXT]
    assert bus_board.questions() == [bytes((index,)) for index in range(len(bus_board.chunks))]
    kinds = [request.cmd1 for request in bus_board.requests()]
    assert kinds.index(bus.SYNC) < kinds.index(bus.FUNCTION)
    first = next(frame for frame in bus_board.frames if frame.message[:2] == ASKED)
    assert first.raw == bytes.fromhex('a50155ff000e')
    with bus_board.unplugged():
        until(lambda: not link.port.is_open)
    until(lambda: len(bus_board.questions()) == 2 * len(bus_board.chunks))
    assert link.texts == [TEXT]


@pytest.mark.parametrize('answer', [
    bus.Reply(bus.ERROR, b'\x00\x80'), bus.Reply(bus.INVALID, b'\x20'), bus.Reply(bus.OK),
    bus.Reply(bus.OK, b'\0\1')],
    ids=('error', 'invalid', 'OK without data', 'OK that is too short'))
def test_any_other_answer_means_that_nothing_is_announced(bus_board, bus_link, answer):
    bus_board.rule = lambda request: answer if request[:2] == ASKED else None
    link = bus_link(retries=0)
    until(lambda: link.texts)
    seen = len(bus_board.executed)
    until(lambda: len(bus_board.executed) > seen + 3)
    assert link.texts == [b''] and bus_board.questions() == [b'\0']


@pytest.fixture
def short_pauses(monkeypatch):
    monkeypatch.setattr(announcement, '_PAUSES', (0.0, 0.01, 0.02, 0.03, 0.04, 0.05),
                        raising=False)


def test_a_board_that_never_answers_the_question_is_asked_six_times(
        bus_board, bus_link, short_pauses, lines):
    bus_board.rule = lambda request: b'' if request[:2] == ASKED else None
    link = bus_link(reply_timeout=0.2, retries=0)
    until(lambda: lines('does not answer the question for its announcement'))
    seen = len(bus_board.executed)
    until(lambda: len(bus_board.executed) > seen + 3)
    # A stall of this machine may end the session; the next one, after SYNC, asks anew.
    sessions = len(bus_board.requests(bus.SYNC))
    assert link.texts == [] and 6 <= len(bus_board.questions()) <= 6 * sessions


class Questions:
    """A question whose answers and times the test sets."""

    def __init__(self, log=None):
        self.asked = []
        self.question = announcement.AnnouncementReader(self._ask, Assembly(), log)
        self.question.opened()
        self.question.restart(0.0)

    def _ask(self, index):
        self.asked.append(Call(bus.ANNOUNCEMENT.make_request((index,)), bus.ANNOUNCEMENT,
                               0.5, 1, 0.0))
        return self.asked[-1]

    def pause(self, now, outcome):
        """The outcome of a question at `now`; return when it is asked again."""
        count = len(self.asked)
        self.question.step(now)
        assert len(self.asked) == count + 1
        self.asked[-1].finish(outcome)
        self.question.step(now)
        for tenth in range(1000):
            self.question.step(now + tenth / 10)
            if len(self.asked) > count + 1:
                del self.asked[-1]
                self.question._call = None
                return now + tenth / 10
        return None


@pytest.mark.parametrize('outcome', [
    Outcome(TIMEOUT, 'no reply'), Outcome(bus.INVALID, 'not synchronised', bus.NOT_SYNCHRONISED)],
    ids=('none', 'not synchronised'))
def test_the_pauses_between_questions_grow(outcome, log):
    questions = Questions(log)
    now, pauses = 0.0, []
    while now is not None:
        after = questions.pause(now, outcome)
        pauses.append(after and after - now)
        now = after
    assert pauses == pytest.approx([0.5, 1.0, 2.0, 4.0, 8.0, None])
    questions.question.restart(100.0)       # a board that always replies that, and then SYNC
    assert questions.question.step(107.9) is None and len(questions.asked) == 6
    questions.question.step(108.0)
    assert len(questions.asked) == 7


@pytest.mark.parametrize('outcome', [
    Outcome(bus.ERROR, 'malformed', 0x8001), Outcome(TIMEOUT, 'no reply'),
    Outcome(bus.OK, '', 0, chunks_of(b'old', 9)[0].pack())],
    ids=('no such chunk', 'none', 'a chunk of the board before'))
def test_a_question_from_before_a_sync_says_nothing_about_the_board_behind_it(log, outcome):
    questions = Questions(log)
    questions.question.step(0.0)
    questions.question.restart(1.0)
    questions.asked[0].finish(outcome)
    texts = [questions.question.step(now) for now in (2.0, 3.0, 4.0)]
    assert texts == [None] * 3 and len(questions.asked) == 2
    questions.asked[1].finish(Outcome(bus.OK, '', 0, chunks_of(b'new', 9)[0].pack()))
    assert questions.question.step(5.0) == b'new'


@pytest.fixture
def log(logger):
    return SparingLog('bus', logger)


class Exchange:
    """A rule for a board that is replaced by another one, which is not synchronised at first."""

    def __init__(self, board):
        self.board = board
        self.synchronised = True
        board.rule = self

    def replace(self, text):
        self.synchronised = False
        self.board.chunks = chunks_of(text, 20)
        del self.board.executed[:]

    def __call__(self, request):
        if request.cmd1 == bus.SYNC:
            self.synchronised = True
        return None if self.synchronised else bus.Reply(bus.INVALID, b'\x10')


PUMP = bus.Request(bus.FUNCTION, 0x30)
PUMP_FUNCTION = bus.Function('pump', 0x30, announced=True)


def test_nothing_announced_is_sent_to_another_board_behind_the_same_port(bus_board, bus_link):
    bus_board.chunks = chunks_of(TEXT, 20)
    exchange = Exchange(bus_board)
    link = bus_link()
    until(lambda: link.texts == [TEXT])
    link.announcement.use(TEXT, '', [])
    link.polls.add(PUMP_FUNCTION, 0.01, lambda outcome: None)
    until(lambda: PUMP in bus_board.executed)
    assert link.request(PUMP, PUMP_FUNCTION).success
    exchange.replace(OTHER)
    outcome = link.request(PUMP, PUMP_FUNCTION)
    assert outcome.status == NOT_SENT or outcome.status == bus.INVALID
    until(lambda: link.texts == [TEXT, OTHER])
    assert not link.announcement.is_current
    assert link.request(PUMP, PUMP_FUNCTION).status == NOT_SENT
    assert PUMP not in bus_board.executed
    exchange.replace(TEXT)
    until(lambda: link.texts == [TEXT, OTHER, TEXT])
    assert link.request(PUMP, PUMP_FUNCTION).success


def test_a_board_that_was_restarted_is_asked_again_after_sync(bus_board, bus_link):
    """The caller's SYNC is the first request that it gets."""
    bus_board.chunks = chunks_of(TEXT, 20)
    link = bus_link()
    until(lambda: link.texts == [TEXT])
    bus_board.chunks = chunks_of(OTHER, 20)
    assert link.call(bus.SYNC_FUNCTION, ()).success
    until(lambda: link.texts == [TEXT, OTHER])


def test_a_bus_board_that_no_longer_announces_is_noticed_after_a_reconnect(bus_board, bus_link):
    bus_board.chunks = chunks_of(TEXT, 20)
    link = bus_link()
    until(lambda: link.texts == [TEXT])
    with bus_board.unplugged():
        until(lambda: not link.port.is_open)
        bus_board.chunks = []
    until(lambda: link.texts == [TEXT, b''])


def test_a_text_that_changes_while_it_is_asked_for_is_read_anew(bus_board, bus_link):
    bus_board.chunks = chunks_of(TEXT, 20)

    def change(request):
        if request[:2] == ASKED and request.data == b'\2':
            bus_board.chunks = chunks_of(OTHER, 10)
    bus_board.rule = change
    link = bus_link()
    until(lambda: link.texts)
    assert link.texts == [OTHER]


def test_a_text_whose_crc_never_matches_is_ignored_after_three_rounds(bus_board, bus_link, lines):
    bus_board.chunks = [chunk._replace(crc=1) for chunk in chunks_of(TEXT, 50)]
    link = bus_link()
    until(lambda: link.texts)
    seen = len(bus_board.executed)
    until(lambda: len(bus_board.executed) > seen + 3)
    assert link.texts == [b''] and len(bus_board.questions()) == 3 * len(bus_board.chunks)
    assert len(lines('does not match its text in 3 rounds')) == 1


def test_a_board_that_ignores_the_index_is_asked_for_three_rounds(bus_board, bus_link, lines):
    bus_board.chunks = chunks_of(TEXT, 20)[:1] * 300
    link = bus_link()
    until(lambda: link.texts)
    assert link.texts == [b''] and len(lines('does not match its text in 3 rounds')) == 1
    assert len(bus_board.questions()) == 3 * len(chunks_of(TEXT, 20))
