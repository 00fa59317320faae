"""The simulated sensor board."""
from simulation_bench import Bench

from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.simulator import OUT_OF_RANGE, SensorBoard


def frames(bench):
    return bench.decoder.feed(bench.output())


def test_rate_and_sequence():
    for arguments, rate in (({}, 20), ({'rate': 50}, 50)):
        bench = Bench(SensorBoard(**arguments), mcu.Decoder())
        bench.run(20.0001)
        seqs = [frame.number for frame in frames(bench)]
        assert seqs == [number % 256 for number in range(20 * rate)]


def test_heading_turns_past_360_degrees():
    bench = Bench(SensorBoard(), mcu.Decoder())
    bench.run(40)
    yaws = [frame.message.yaw for frame in frames(bench)]
    assert all(0 <= yaw <= 360 for yaw in yaws)
    assert max(yaws) > 358 and any(327.67 < yaw < 340 for yaw in yaws)
    assert sum(after < before for before, after in zip(yaws, yaws[1:])) == 2


def test_ranges_change_and_some_time_out():
    bench = Bench(SensorBoard(seed=1), mcu.Decoder())
    bench.run(120)
    ranges = [frame.message.range_1 for frame in frames(bench)]
    assert mcu.RANGE_TIMED_OUT in ranges and OUT_OF_RANGE in ranges
    measured = [value for value in ranges if value <= 2100]
    assert min(measured) < 300 and max(measured) > 1800
    assert ranges.count(mcu.RANGE_TIMED_OUT) < len(ranges) / 50


def test_without_its_imu_the_angles_are_unknown():
    bench = Bench(SensorBoard(imu=False), mcu.Decoder())
    bench.run(2)
    messages = [frame.message for frame in frames(bench)]
    assert messages and not any(message.angles_known for message in messages)
    assert any(message.range_1 != mcu.RANGE_TIMED_OUT for message in messages)
