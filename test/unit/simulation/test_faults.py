"""Faults on demand: each kind happens, and can be repeated."""

import pytest
from simulation_bench import Bench

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.arduino.simulator import ModelCar
from serial_communication.boards.bus.simulator import ControlBoard
from serial_communication.simulation.faults import Faults, parse
from serial_communication.boards.mcu.simulator import SensorBoard

SYNC = bus.encode_request(bus.SYNC_REQUEST)
HEARTBEAT = arduino.encode(arduino.Heartbeat())


def make(board, decoder, *texts, seed=1, **arguments):
    return Bench(board, decoder, faults=Faults(parse(' '.join(texts), board), seed), **arguments)


def sensors(*texts, seed=1, **arguments):
    return make(SensorBoard(seed=1), mcu.Decoder(), *texts, seed=seed, **arguments)


def car(*texts, seed=1, **arguments):
    return make(ModelCar(seed=1), arduino.Decoder(), *texts, seed=seed, **arguments)


def control(*texts, seed=1, **arguments):
    return make(ControlBoard(seed=1), bus.ReplyDecoder(), *texts, seed=seed, **arguments)


# -- of the line --------------------------------------------------------------------------------


@pytest.mark.parametrize('kind, is_it', [
    ('drop', lambda frame, left: not left),
    ('cut', lambda frame, left: frame.startswith(left) and 0 < len(left) < len(frame)),
    ('lose', lambda frame, left: len(frame) - 3 <= len(left) < len(frame)),
    ('flip', lambda frame, left: len(left) == len(frame) and sum(
        bin(one ^ other).count('1') for one, other in zip(frame, left)) == 1),
    ('insert', lambda frame, left: len(frame) < len(left) <= len(frame) + 3),
    ('double', lambda frame, left: left == frame + frame)])
@pytest.mark.parametrize('direction', ['', 'rx-'])
def test_damage_is_done_at_its_rate_in_its_direction(kind, is_it, direction):
    faults = Faults(parse(f'{direction}{kind}=0.2'), 1)
    found = [(frame, faults.damaged(frame, direction))
             for frame in (bytes((number % 256, 1, 2, 3, 4)) for number in range(2000))]
    hit = [each for each in found if each[0] != each[1]]
    assert 300 < len(hit) < 500 and all(is_it(*each) for each in hit)
    assert faults.counts == {direction + kind: len(hit)}
    assert faults.damaged(SYNC, '' if direction else 'rx-') == SYNC


def test_a_delayed_frame_is_not_overtaken():
    bench = sensors('delay=0.02:0.6-1')
    bench.run(100)
    assert bench.line.faults.counts['delay'] > 20
    seqs = [frame.number for frame in bench.decoder.feed(bench.output())]
    assert seqs == [number % 256 for number in range(len(seqs))]
    times = [time for time, _ in bench.wire]
    assert 0.6 < max(after - before for before, after in zip(times, times[1:])) < 1.2


# -- events -------------------------------------------------------------------------------------


def test_a_reset_sends_chatter_and_clears_the_state():
    bench = sensors('reset=6/min')
    bench.run(100)
    output = bench.output()
    boots = len(bench.notes('boot')) - 1
    assert boots >= 4 and output.count(SensorBoard.CHATTER) in (boots, boots + 1)
    seqs = [frame.number for frame in bench.decoder.feed(output) if not frame.cause]
    assert seqs.count(0) >= boots + 1
    bench = control('reset=6/min')
    bench.feed(SYNC)
    assert bench.run(100, until=lambda: len(bench.notes('boot')) == 2)
    assert not bench.board.synchronised


# -- repeating a run -----------------------------------------------------------


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
    assert first.wire != other.wire


# -- the board's clock, and an adapter -----------------------------------------------------------


def timed(bench):
    """The messages but the times, each with when it was sent, and the board's time, as decoded."""
    frames = bench.decoder.feed(bench.output())
    assert not any(frame.cause for frame in frames)
    times = [time for time, data in bench.wire if data != b'\0']
    assert len(times) == len(frames)
    return [(frame.message, time, frame.ticks) for time, frame in zip(times, frames)
            if not isinstance(frame.message, (arduino.Time, mcu.Time))]


@pytest.mark.parametrize('make_one', [car, sensors])
@pytest.mark.parametrize('ppm', [0, 5000, -300.5])
def test_every_measurement_has_the_time_of_a_clock_that_drifts(make_one, ppm):
    bench = make_one(f'drift={ppm}')
    bench.run(2)
    measured = [(time, ticks) for message, time, ticks in timed(bench)
                if not isinstance(message, arduino.Text)]
    assert len(measured) >= 40
    assert [ticks for _, ticks in measured] == pytest.approx(
        [(time - 1000.0) * (1e6 + ppm) for time, _ in measured], abs=1)


@pytest.mark.parametrize('ms', [1, 16])
def test_an_adapter_delivers_in_batches_what_was_on_the_line_before(ms):
    bench, plain = car(f'batch={ms}'), car()
    for each in bench, plain:
        each.run(2.0001)
    steps = [time * 1000 / ms for time, _ in bench.wire]
    assert steps == pytest.approx(list(map(round, steps)), abs=1e-6)
    delays = [after - before for (before, _), (after, _) in zip(plain.wire, bench.wire)]
    assert -1e-9 <= min(delays) and max(delays) < 1.001e-3 * ms
    assert [data for _, data in bench.wire] == [data for _, data in plain.wire[:len(bench.wire)]]


# -- parsing ------------------------------------------------------------------------------------


@pytest.mark.parametrize('text, says', [
    ('flip', 'KIND=RATE'), ('flip=', 'KIND=RATE'), ('flip=-1', 'KIND=RATE'),
    ('flip=nan', 'KIND=RATE'), ('flap=0.1', 'no fault'), ('flip=2', '0 to 1'),
    ('rx-flip=2', '0 to 1'), ('silence=0.1', '/min'), ('batch=-1', 'KIND=RATE'),
    ('batch=1/min', 'ms'), ('batch=1001', '1000 ms'), ('flip=0.1:3', 'no duration'),
    ('delay=0.1:2-1', 'is empty')])
def test_an_invalid_fault_is_refused_with_the_reason(text, says):
    for board in (None, ControlBoard, SensorBoard):
        with pytest.raises(ValueError, match=says):
            parse(f'cut=0.1 {text}', board)


def test_faults_are_left_out_where_a_board_cannot_have_them():
    text = 'flip=0.02 rx-flip=0.1 stall=1/min drift=-20'
    assert list(parse(text, ControlBoard)) == ['flip', 'rx-flip', 'stall']
    assert list(parse(text, SensorBoard)) == ['flip', 'drift']
    assert len(parse('all', ModelCar)) == len(ModelCar.FAULTS.split())
    assert parse('all flip=0.5', ModelCar)['flip'].number == 0.5
    assert parse('none', ModelCar) == parse('', ModelCar) == {}
