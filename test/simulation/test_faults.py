"""Faults on demand: each kind happens, can be repeated, and is noted in the journal."""

import pytest
from simulation_bench import Bench

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.arduino.simulator import ModelCar
from serial_communication.boards.bus.simulator import ControlBoard
from serial_communication.simulation.faults import KINDS, EveryBoard, Faults, for_every_board, parse
from serial_communication.boards.mcu.simulator import SensorBoard

SYNC = bus.encode_request(bus.SYNC_REQUEST)
HEARTBEAT = arduino.encode(arduino.Heartbeat())


def make(board, decoder, *texts, seed=1, **arguments):
    return Bench(board, decoder, faults=Faults(parse(texts, board), seed), **arguments)


def sensors(*texts, seed=1, **arguments):
    return make(SensorBoard(seed=1), mcu.Decoder(), *texts, seed=seed, **arguments)


def car(*texts, seed=1, **arguments):
    return make(ModelCar(seed=1), arduino.Decoder(), *texts, seed=seed, **arguments)


def control(*texts, seed=1, **arguments):
    return make(ControlBoard(seed=1), bus.ReplyDecoder(), *texts, seed=seed, **arguments)


def sent(bench, fault):
    """The frames in the journal that had that fault."""
    return [fields for fields in bench.notes.of('tx') if fault in fields.get('faults', ())]


def wire(fields):
    return bytes.fromhex(fields['wire'])


def raw(fields):
    return bytes.fromhex(fields['raw'])


# -- what a board sends -------------------------------------------------------------------------


@pytest.mark.parametrize('kind, is_it', [
    ('cut', lambda frame, wire: frame.startswith(wire) and 0 < len(wire) < len(frame)),
    ('lose', lambda frame, wire: len(frame) - 3 <= len(wire) < len(frame)),
    ('flip', lambda frame, wire: len(wire) == len(frame) and sum(
        bin(one ^ other).count('1') for one, other in zip(frame, wire)) == 1),
    ('insert', lambda frame, wire: len(frame) < len(wire) <= len(frame) + 3),
])
def test_a_fault_changes_frames_at_its_rate_and_the_journal_has_both(kind, is_it):
    bench = sensors('%s=0.2' % kind)
    bench.run(100)
    hit = sent(bench, kind)
    assert 300 < len(hit) < 500
    assert all(is_it(raw(fields), wire(fields)) and not fields['ok'] for fields in hit)
    assert sum(fields['ok'] for fields in bench.notes.of('tx')) == 2000 - len(hit)
    assert b''.join(data for _, data in bench.wire) == b''.join(
        wire(fields) if 'wire' in fields else raw(fields) for fields in bench.notes.of('tx'))
    assert bench.line.faults.counts == {kind: len(hit)}


@pytest.mark.parametrize('kind', ['delay', 'late'])
def test_a_delayed_frame_is_not_overtaken(kind):
    bench = sensors('%s=0.02' % kind)
    bench.run(100)
    assert len(sent(bench, kind)) > 20
    seqs = [frame.number for frame in bench.decoder.feed(bench.output())]
    assert seqs == [number % 256 for number in range(len(seqs))]
    times = [time for time, _ in bench.wire]
    longest = max(after - before for before, after in zip(times, times[1:]))
    low, high = KINDS[kind].seconds
    assert low < longest < high + 0.2


# -- what a board receives ----------------------------------------------------------------------


@pytest.mark.parametrize('kind', ['rx-drop', 'rx-lose', 'rx-flip', 'rx-insert'])
def test_a_fault_of_the_input_changes_what_the_board_receives(kind):
    bench = control('%s=0.3' % kind)
    for _ in range(300):
        bench.feed(bus.encode_request(bus.echo(b'12345678')))
        bench.run(0.2)
    hit = bench.notes.of('rx-fault')
    assert 60 < len(hit) < 120
    assert all(fields['faults'] == [kind] and fields['came'] != fields['became']
               for fields in hit)
    invalid = [fields for fields in bench.notes.of('request') if not fields['valid']]
    if kind == 'rx-flip':
        # A flipped bit in DATE or the checksum leaves the form of a frame, which is answered.
        answers = [fields for fields in bench.notes.of('tx') if '0x40' in fields['text']]
        assert invalid and answers and len(answers) <= len(hit)
    if kind == 'rx-drop':
        assert not invalid


def test_lost_heartbeats_stop_the_motor():
    bench = car('rx-drop=0.9')
    for _ in range(300):
        bench.feed(HEARTBEAT + arduino.encode(arduino.SpeedCommand(300)))
        bench.run(0.01)
    assert any(fields['why'] == 'no heartbeat for 30 ms' for fields in bench.notes.of('motor'))


# -- events -------------------------------------------------------------------------------------


def test_a_reset_sends_chatter_and_clears_the_state():
    bench = sensors('reset=6/min')
    bench.run(100)
    output = bench.output()
    boots = len(bench.notes.of('boot')) - 1
    assert boots >= 4 and output.count(SensorBoard.CHATTER) == boots
    seqs = [frame.number for frame in bench.decoder.feed(output) if not frame.cause]
    assert seqs.count(0) >= boots + 1
    bench = control('reset=6/min')
    bench.feed(SYNC)
    assert bench.run(100, until=lambda: len(bench.notes.of('boot')) == 2)
    assert not bench.board.synchronised
    bench = car('reset=6/min')
    logs = []
    for _ in range(100):
        bench.run(1)
        logs += bench.messages(arduino.Log)
    boots = len(bench.notes.of('boot'))
    assert boots > 4 and logs.count(arduino.Log(1, 'IMU ready')) == boots


# -- repeating a run, and its journal -----------------------------------------------------------


def exercise(bench):
    """Send the same requests to each bench at the same times."""
    for number in range(400):
        if bench.board.NAME == 'bus':
            bench.feed(bus.encode_request(bus.SYNC_REQUEST if number % 5 == 0
                                          else bus.echo(b'%d' % number)))
        elif bench.board.NAME == 'arduino':
            bench.feed(HEARTBEAT)
        bench.run(0.09)
    return bench


@pytest.mark.parametrize('make_one', [sensors, car, control])
def test_the_same_seed_repeats_a_run(make_one):
    texts = ['all', 'flip=0.05', 'drop=0.05', 'reset=3/min', 'delay=0.02']
    first, second, other = (exercise(make_one(*texts, seed=seed)) for seed in (3, 3, 4))
    assert first.wire == second.wire
    assert list(first.notes) == list(second.notes)
    assert first.wire != other.wire


# -- the line's speed ---------------------------------------------------------------------------


def test_a_baud_rate_limits_how_fast_bytes_are_written():
    bench = control(baud=115200)
    bench.feed(SYNC)
    start = bench.now
    bench.feed(bus.encode_request(bus.echo(bytes(1000))))
    assert bench.run(1, until=lambda: len(bench.notes.of('tx')) == 2)
    assert bench.now - start == pytest.approx((4 + 1000 + 5) * 10 / 115200, rel=0.02)
    assert max(len(data) for _, data in bench.wire) <= 16
    assert bench.messages()[-1] == bus.Reply(bus.ECHO, bytes(1000))


# -- the board's clock, and an adapter -----------------------------------------------------------


def timed(bench):
    """The messages but the times, each with when it was sent, and the board's time, as decoded."""
    frames = bench.decoder.feed(bench.output())
    assert not any(frame.cause for frame in frames)
    times = [time for time, event, _ in bench.notes if event == 'tx']
    assert len(times) == len(frames)
    return [(frame.message, time, frame.ticks) for time, frame in zip(times, frames)
            if not isinstance(frame.message, (arduino.Time, mcu.Time))]


@pytest.mark.parametrize('make_one', [car, sensors])
@pytest.mark.parametrize('ppm', [0, 5000, -300.5])
def test_every_measurement_has_the_time_of_a_clock_that_drifts(make_one, ppm):
    bench = make_one(f'drift={ppm}')
    bench.run(2)
    measured = [(time, ticks) for message, time, ticks in timed(bench)
                if not isinstance(message, arduino.Log)]
    assert len(measured) >= 40
    assert [ticks for _, ticks in measured] == pytest.approx(
        [(time - 1000.0) * (1e6 + ppm) for time, _ in measured], abs=1)


@pytest.mark.parametrize('ms', [1, 16])
def test_an_adapter_delivers_in_batches_what_was_on_the_line_before(ms):
    bench, plain = (car(*texts, baud=115200) for texts in ([f'batch={ms}'], []))
    for each in bench, plain:
        each.run(2)
    steps = [time * 1000 / ms for time, _ in bench.wire]
    assert steps == pytest.approx(list(map(round, steps)), abs=1e-6)
    delays = [after - before for (before, _), (after, _) in zip(plain.wire, bench.wire)]
    assert 0 <= min(delays) and 0.8e-3 * ms < max(delays) < 1.001e-3 * ms
    assert [data for _, data in bench.wire] == [data for _, data in plain.wire[:len(bench.wire)]]


# -- parsing ------------------------------------------------------------------------------------


@pytest.mark.parametrize('text, says', [
    ('flip', 'KIND=RATE'), ('flip=', 'KIND=RATE'), ('flip=-1', 'KIND=RATE'),
    ('flip 0.1', 'KIND=RATE'), ('flip=nan', 'KIND=RATE'), ('flap=0.1', 'no fault'),
    ('flip=2', '0 to 1'), ('rx-flip=2', '0 to 1'), ('silence=0.1', '/min'),
    ('batch=-1', 'KIND=RATE'), ('batch=1/min', 'ms'), ('batch=1001', '1000 ms'),
    ('flip=0.1:3', 'no duration'), ('delay=0.1:2-1', 'is empty')])
def test_an_invalid_fault_is_refused_with_the_reason(text, says):
    with pytest.raises(ValueError, match=says):
        parse([text], ControlBoard)
    if ' ' not in text:
        for board in (EveryBoard, ControlBoard, SensorBoard):
            with pytest.raises(ValueError, match=says):
                for_every_board(text, board)
