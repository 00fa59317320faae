"""The parts of the bench that measure nothing: matching, figures, goals, tables and packets."""
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from bench import arguments, report, sections, stage
from bench.boards import COUNT, arduino_turn, imu_count, mcu_turn
from processes import StageError
from serial_communication.boards import description
from waiting import until


def test_a_percentile_is_one_of_the_values():
    values = [5, 1, 4, 2, 3]
    assert [report.percentile(values, percent) for percent in (0, 20, 50, 99, 100)] == [
        1, 1, 3, 5, 5]


def test_the_least_value_of_each_figure_is_the_best():
    assert report.best([{'a': 2, 'b': 5}, {'a': 3, 'b': 4, 'c': 1}]) == {'a': 2, 'b': 4, 'c': 1}


def test_sides_are_measured_in_turn():
    asked, figures = [], {'A': [3, 1, 2], 'B': [4, 6, 5]}

    def measure(name):
        asked.append(name)
        return {'ms': figures[name][asked.count(name) - 1]}

    results = sections._in_turn(SimpleNamespace(rounds=3), {
        name: lambda name=name: measure(name) for name in figures})
    assert asked == list('ABABAB')
    assert results == {'A': {'ms': 1}, 'B': {'ms': 4}}


def test_latencies_exclude_packets_of_an_earlier_round():
    sent = [[1.0, 1.5], [2.0, 2.5]]
    received = [(0, 0, 1.25), (1, 0, 1.75), (1, 1, 3.0), (1, 1, 3.5),
                (0, 1, 0.5), (0, 2, 3.0)]      # these two are of an earlier round
    assert report.latencies(sent, received) == [0.25, 0.25, 0.5]


def test_errors_of_stamps_are_those_of_whole_turns():
    received = [(0, 0, 9.9, 1.5), (0, 1, 9.9, 2.25), (1, 1, 9.9, 7.0), (0, 2, 9.9, 2.5),
                (0, 4, 9.9, 5.5)]
    errors, distances = report.stamp_errors([1.0, 2.0, 3.0, 4.0, 5.0], received)
    assert (errors, distances) == ([0.5, 0.25, 0.5, 0.5], [0.25, 0.75])


def test_gaps_count_only_while_a_call_waits():
    # (first byte of the request, last byte of the reply)
    exchanges = [(1.0, 2.0), (2.25, 3.0), (9.0, 9.5)]
    calls = [(0.5, 2.1, True), (0.75, 3.1, True), (8.9, 9.6, True)]
    assert report.gaps_in_queue(exchanges, calls, 0.001) == [0.25]
    # A call that has just begun may not be in the queue yet.
    assert report.gaps_in_queue(exchanges[:2], [(0.5, 2.1, True), (1.9, 3.1, True)], 0.5) == []


@pytest.mark.parametrize('n', (0, 1, 255, 1023, 70000))
def test_a_running_number_is_decoded_again(n):
    frames = description('arduino').decoder(False, {}).feed(b''.join(arduino_turn(n)))
    imu, steering = frames[0].message, frames[1].message
    assert imu_count(imu.linear_acceleration()[2]) == n % COUNT == steering.value
    assert len(frames) == 4 and not any(frame.cause for frame in frames)


def test_the_frames_of_the_sensor_board_are_valid():
    frame, = description('mcu').decoder(False, {}).feed(b''.join(mcu_turn(300)))
    assert not frame.cause and frame.message.range_1 == 300


# -- goals and tables -------------------------------------------------------------------------

HEARTBEAT = 'heartbeat: deviation, ms'
RESULTS = {
    'latency': {'bridge': {'p50, ms': 1.0, 'p99, ms': 9.0, HEARTBEAT: 0.1, report.SCHEDSTAT: 4.0,
                           'a link, ms in 10 s': 200.0, 'idle, ms in 10 s': 1.0},
                'old': {'p50, ms': 2.0, 'p99, ms': 9.0, HEARTBEAT: 0.1, report.SCHEDSTAT: 2.0,
                        'a link, ms in 10 s': 100.0, 'idle, wake-ups per packet': 0.01},
                'polling': {'p50, ms': 10.0, 'p99, ms': 10.0, HEARTBEAT: 0.1}},
    'bus': {'bridge': {'get: gap p50, ms': 0.1, 'echo: gap p50, ms': 0.29, 'echo: failed': 3}},
    'flood': {'bridge': {'bytes lost at the port': 1, 'messages lost': 0, 'CPU, % of a core': 5}}}


def test_goals_are_judged_only_for_sections_that_ran():
    assert report.judge({}) == []
    assert [(limit, value, met) for _what, limit, value, met in report.judge(RESULTS)] == [
        (0.20, 0.1, 'met'), (0.60, 0.9, 'NOT MET'), (0.5, 1.0, 'NOT MET'), (0.3, 0.29, 'met'),
        (0, 1, 'NOT MET')]


def test_goals_and_the_option_only_know_every_section():
    assert {goal.section for goal in report.GOALS} == set(sections.SECTIONS)
    assert arguments.SECTIONS == tuple(sections.SECTIONS)


def test_the_report_compares_the_bridge_with_another_commit():
    text = report.render('this machine', RESULTS, dict.fromkeys(RESULTS, 'title'), 'old')
    rows = [line.split() for line in text.split('\n')]
    assert ['p50,', 'ms', '1.00', '2.00', '10.00', '0.50'] in rows
    assert ['a', 'link,', 'ms', 'in', '10', 's', '200.00', '100.00', '2.00'] in rows
    assert 'idle' not in text
    assert text.startswith('this machine\n')


def test_the_bridge_is_to_cost_at_most_a_tenth_more_than_another_commit():
    results = {'latency': {'bridge': {'p50, ms': 1.1, 'p99, ms': 2.3, report.SCHEDSTAT: 3.0},
                           'old': {'p50, ms': 1.0, 'p99, ms': 2.0, report.SCHEDSTAT: 2.0},
                           'polling': {'p50, ms': 9.0, 'p99, ms': 9.0}}}
    for side in results['latency'].values():
        side[HEARTBEAT] = 0.1
    assert [row[3] for row in report.judge(results, 'old')] == ['met'] * 2 + ['NOT MET', 'met'] \
        + ['NOT MET'] * 2


def test_an_unknown_commit_is_reported():
    with pytest.raises(StageError, match='--against no-such-commit: .*no-such-commit'):
        stage.BenchStage('no-such-commit')


def sleeps(pid):
    """Whether all threads of a process do."""
    return all((task / 'stat').read_text().rsplit(')', 1)[1].split()[0] == 'S'
               for task in Path(f'/proc/{pid}/task').iterdir())


def test_threads_have_their_names_in_the_kernel_and_their_wake_ups_are_counted(tmp_path):
    program = tmp_path / 'program'
    program.write_text('import sys, threading\n'
                       'def read():\n    for line in sys.stdin: print("read", flush=True)\n'
                       'threading.Thread(target=read, name="a reader").start()\n'
                       'print(sys.argv[1:], flush=True)\n')
    with subprocess.Popen(['/usr/bin/python3', '-c', stage._NAMED_THREADS, str(program), 'given'],
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "['given']\n"
            before = sections.threads_of(process.pid)
            for _ in range(10):
                until(lambda: sleeps(process.pid))      # else no thread has to be woken
                process.stdin.write('a line\n')
                process.stdin.flush()
                assert process.stdout.readline() == 'read\n'
            found = sections.thread_figures(before, sections.threads_of(process.pid), 2.0, 10)
            assert 0.5 <= found['a reader, wake-ups per packet'] <= 2
            assert found['all threads, wake-ups per packet'] >= 0.5
            assert 0 < found['a reader, ms in 10 s'] < found['all threads, ms in 10 s'] + 1e-6
        finally:
            process.stdin.close()
