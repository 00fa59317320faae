"""What the Master says and returns; when it sends what, the judge decides (test/sim)."""
import logging

import pytest
from board_rows import functions
from bus_moves import gimbal, lift

from serial_communication.boards.bus import polls, wire as bus
from serial_communication.boards.bus.call import MasterOptions
from serial_communication.boards.bus.session import MasterSession
from serial_communication.framing.announcement import Assembly
from serial_communication.framing.layout import Layout, Value
from serial_communication.framing.stream import FRAMING, Frame, invalid_frame
from serial_communication.link.outcome import NOT_SENT, TIMEOUT, Outcome
from serial_communication.link.session import Packet
from serial_communication.link.sparing_log import SparingLog
from serial_communication.simulation.announcing import chunks_of

AIR = bus.Environment(350, 25.63, 48.12).pack()
LEVEL = bus.Function('level', 0x41, repeatable=True, reply=Layout('<H', [
    Value('number', maximum=999)]))
TEXT = b'firmware: lift_board 1.0\npump: {cmd2: 48, srv_type: std_srvs/SetBool}\n'
LOG = SparingLog('bus', logging.getLogger('master'))


class Master(MasterSession):
    """In step with a board that answers each ECHO at once; other replies are the test's."""

    echoes = True

    def __init__(self, **options):
        super().__init__(LOG, MasterOptions(**options))
        self.now, self.sent = 100.0, []
        self.begin(self.now, is_opening=True)
        self.run()
        self.reply(bus.Reply(bus.SYNC))

    def reply(self, reply):
        self.presence.byte_at = self.now
        self.received(Frame(b'', reply.cmd1, 0, reply.data, reply), self.now)
        self.run()

    def run(self):
        """Send what is due."""
        for packet in self.due(self.now, True)[0]:
            self.sent.append(packet.message)
            if packet.type == bus.ECHO and self.echoes:
                self.reply(bus.Reply(bus.ECHO, packet.data))

    def call(self, request, function):
        call = self.options.call(request, function, self.now)
        self.submit(call, self.now)
        self.run()
        return call


def test_an_outcome_has_the_data_and_the_round_trip():
    master = Master()
    call = master.call(bus.ENVIRONMENT_REQUEST, bus.ENVIRONMENT_FUNCTION)
    master.now += 0.125
    master.reply(bus.Reply(bus.OK, AIR))
    assert call.outcome.success
    assert (call.outcome.data, call.outcome.round_trip) == (AIR, 0.125)
    assert dict(master.values())['round trip max [ms]'] == '125.00'


@pytest.mark.parametrize('data, cause', [(b'', 'length'), (b'\xff\xff', 'implausible')])
def test_a_reply_that_its_row_does_not_allow_is_counted_and_no_success(data, cause):
    master = Master()
    call = master.call(bus.Request(bus.FUNCTION, 0x41), LEVEL)
    master.reply(bus.Reply(bus.OK, data))
    assert (call.outcome.status, call.outcome.success) == (bus.OK, False)
    assert master.errors[cause] == 1


def test_without_echo_an_ok_with_data_is_the_reply_to_another_request():
    master = Master(echo=False)
    master.now += 0.6       # a silence is the fence
    call = master.call(lift(0, 100), bus.LIFT_FUNCTION)
    master.reply(bus.Reply(bus.OK, AIR))
    assert master.sent[-1] == lift(0, 100) and call.outcome is None
    master.reply(bus.Reply(bus.OK))
    assert call.outcome.success


def test_a_move_that_was_not_written_ends_at_once_and_the_next_one_is_sent():
    master = Master()
    call = master.call(lift(0, 100), bus.LIFT_FUNCTION)
    master.not_sent(Packet(b'', *master.sent[-1], master.sent[-1]), 'the port takes no data')
    assert call.outcome == Outcome(NOT_SENT, 'the port takes no data; nothing was sent')
    master.call(lift(0, 200), bus.LIFT_FUNCTION)
    assert master.sent[-1] == lift(0, 200)


@pytest.mark.parametrize('request_, function', [
    (lift(0, 100), bus.LIFT_FUNCTION), (bus.Request(bus.FUNCTION, 0x30, b'x'), bus.RAW)])
@pytest.mark.parametrize('code, then, status', [
    (0x40, 'OK', TIMEOUT), (0x40, 'noise', TIMEOUT), (0x40, 'the port closes', TIMEOUT),
    (0x20, 'OK', TIMEOUT), (0x20, 'ECHO', bus.INVALID), (0x40, 'ECHO', None)])
def test_a_move_is_refused_only_if_nothing_but_an_echo_follows_the_invalid(
        request_, function, code, then, status):
    """Else the INVALID was perhaps for noise, and the move is done."""
    master = Master()
    call = master.call(request_, function)
    master.echoes = False
    master.reply(bus.Reply(bus.INVALID, bytes((code,))))
    assert call.outcome is None and master.sent[-1].cmd1 == bus.ECHO
    if then == 'noise':
        master.damaged(invalid_frame(b'\xa5', FRAMING, then), master.now)
    elif then == 'the port closes':
        master.end(then, master.now)
    else:
        master.reply(bus.Reply(bus.OK) if then == 'OK'
                     else bus.Reply(bus.ECHO, master.sent[-1].data))
    master.run()
    assert (call.outcome and call.outcome.status) == status
    assert master.sent.count(request_) == (2 if status is None else 1)


@pytest.mark.parametrize('keys, said', [
    ({}, '"lift up 100 mm" is under way'),
    ({'halt': {'cmd2': 0x2F, 'srv_type': 'std_srvs/Trigger', 'repeatable': True,
               'interrupts': True}}, '')])
def test_a_stop_names_the_move_that_it_cannot_interrupt(keys, said):
    master = Master()
    master.stops += [(each.make_request(()), each) for each in functions(keys)]
    master.call(lift(0, 100), bus.LIFT_FUNCTION)
    waiting = master.call(gimbal(1, 45), bus.GIMBAL_FUNCTION)
    master.is_stopped = True
    packets, moving = master.stop(master.now)
    master.run()
    assert moving == said and [packet.number for packet in packets] == [0x2F] * len(keys)
    assert waiting.outcome.status == NOT_SENT and gimbal(1, 45) not in master.sent


# -- the question for an announcement -------------------------------------------------------------

class Questions:
    """A question whose answers and times the test sets."""

    def __init__(self):
        self.asked = []
        self.reader = polls.AnnouncementReader(self._ask, Assembly(), LOG)
        self.reader.begin(0.0)

    def _ask(self, request, function, now, on_success):
        self.asked.append(MasterOptions().call(request, function, now, on_success))
        return self.asked[-1]


@pytest.mark.parametrize('outcome', [
    Outcome(TIMEOUT, 'no reply'), Outcome(bus.INVALID, 'not synchronised', bus.NOT_SYNCHRONISED)],
    ids=('none', 'not synchronised'))
def test_without_an_answer_it_is_asked_again_five_times_with_growing_pauses(outcome):
    questions, asked_at = Questions(), []
    for tenth in range(1000):
        questions.reader.tick(tenth / 10)
        if len(questions.asked) > len(asked_at):
            asked_at.append(tenth / 10)
            questions.asked[-1].finish(outcome)
            questions.reader.tick(tenth / 10)
    assert asked_at == pytest.approx([0.0, 0.5, 1.5, 3.5, 7.5, 15.5])


@pytest.mark.parametrize('outcome', [
    Outcome(bus.ERROR, 'x', 0x8001), Outcome(bus.INVALID, 'x', 0x20)], ids=('error', 'invalid'))
def test_a_refusal_means_that_nothing_is_announced(outcome):
    questions = Questions()
    questions.reader.tick(0.0)
    questions.asked[0].finish(outcome)
    assert questions.reader.tick(0.1) == b'' and len(questions.asked) == 1


def test_each_chunk_is_asked_for_once():
    questions, chunks = Questions(), chunks_of(TEXT, 20)
    for index, chunk in enumerate(chunks):
        questions.reader.tick(0.0)
        assert questions.asked[-1].request.data == bytes((index,))
        questions.asked[-1].finish(Outcome(bus.OK, '', 0, chunk.pack()))
        text = questions.reader.tick(0.0)
    assert text == TEXT and len(questions.asked) == len(chunks)
    assert bus.encode_request(questions.asked[0].request) == bytes.fromhex('a50155ff000e')
