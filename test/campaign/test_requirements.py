"""The table of the requirements, and when it is red."""
import pathlib
from types import SimpleNamespace

import pytest

pytest.importorskip('rospy')
from campaign import cli, requirements  # noqa: E402
from campaign.requirements import Table  # noqa: E402

FOLDER = pathlib.Path(requirements.__file__).parent


@pytest.fixture
def row(table):
    return table.row('heartbeats: 100 a second')


@pytest.fixture
def table():
    """Each requirement of the exact part was checked just often enough."""
    table = Table()
    table.runs['exact'] = 2
    for each in table.rows:
        each.checks = each.least
    assert not table.failed
    return table


def test_table_of_some_scenarios():
    table = Table()
    row = table.row('data is published again within 1 s of a stall')
    row.check(True, '')
    assert not table.failed and 'only a part of the scenarios was run' in str(table)
    row.at_most(3.0, 2.0, 's', 'too late')
    row.undecided += 1
    assert table.failed == [row] and row.worst_case == '3 s'
    text = str(table)
    assert text.endswith('\n1 requirements, only a part of the scenarios was run; '
                         '1 violated; 1 checks not decided')
    assert 'VIOLATED' in text and 'too late: 3 s, limit 2 s' in text and 'memory' not in text
    assert [line.split() for line in text.splitlines() if row.text in line][0][-6:] == [
        '0', '2', '1', '1', '3', 's']
    with pytest.raises(KeyError):
        table.row('not in the list')


def test_a_requirement_that_was_checked_too_seldom_is_red(table, row):
    assert 'each tried as often as it has to be; 0 violated' in str(table)
    row.checks -= 1
    assert table.failed == [row] and '; 0 violated' in str(table)
    assert 'NOT TRIED ENOUGH' in str(table) and '1 not tried as often as they have' in str(table)


def test_a_requirement_that_was_not_decided_too_often_is_red(table, row):
    row.undecided = 2
    assert not table.failed
    row.undecided = 3
    assert table.failed == [row] and 'NOT DECIDED TOO OFTEN' in str(table)
    assert str(table).endswith('3 checks not decided, too many of 1 requirements')
    row.checks = 60
    assert not table.failed


def test_results_of_a_try_that_the_machine_spoiled_are_taken_back(table, row):
    row.at_most(1.0, 2.0, 's', '')
    before = table.results()
    assert table.grown('violations', before) == []
    row.at_most(3.0, 2.0, 's', 'too late')
    other = table.row('data is published again within 1 s of a stall')
    other.check(True, '')
    assert table.grown('violations', before) == [row]
    table.take_back(before)
    assert (row.checks, row.violations, row.undecided, row.examples) == (5, 0, 0, [])
    assert row.worst_case == '1 s' and (other.checks, other.undecided) == (12, 0)
    assert not table.failed


@pytest.mark.parametrize('stalls, results, tries, violations, undecided', [
    (False, 'V', 1, 1, 0), (True, 'VVO', 3, 0, 0), (True, 8 * 'V', 8, 1, 0), (True, 'O', 1, 0, 0),
    (False, 'UUO', 3, 0, 0), (False, 8 * 'U', 8, 0, 1), (False, 'UV', 2, 1, 0)])
def test_a_scenario_that_the_machine_spoiled_is_tried_again(stalls, results, tries, violations,
                                                            undecided):
    """Each try fulfils (O) or violates (V) a requirement, or does not decide it (U)."""
    table, left = Table(), list(results)
    row = table.row('heartbeats: 100 a second')
    rig = SimpleNamespace(table=table, row=table.row, settle=lambda: None, restore=lambda: None,
                          check_always=lambda: None,
                          machine=SimpleNamespace(stalled=lambda since, until: stalls))

    def scenario(_rig):
        result = left.pop(0)
        row.undecided += result == 'U'
        row.check(result != 'V', '')
    cli.carry_out(rig, scenario)
    assert (len(results) - len(left), row.violations, row.undecided) == (
        tries, violations, undecided)
    assert row.checks == 1


def test_results_of_two_processes_are_added(table, row):
    other = Table()
    other.row(row.text).at_most(3.0, 2.0, 's', 'too late')
    other.row(row.text).undecided += 1
    for _process in range(2):
        table.add(other.dump())
    table.add('')       # a process that has ended early
    assert (row.checks, row.violations, row.undecided) == (6, 2, 2)
    assert row.worst_case == '3 s' and table.violated == [row] and '0.0 s' in row.failure
    assert row.examples == 2 * ['too late: 3 s, limit 2 s']


def test_the_storm_has_its_own_checks_and_least_numbers():
    table, text = Table(), 'outcome done: executed exactly once'
    table.row(text).check(True, '')
    table.part, table.runs['storm'] = 'storm', 0.5
    table.row(text).check(True, '')
    found = [each for each in table.rows if each.text == text]
    assert [each.group for each in found] == ['bus', 'storm: bus']
    assert [each.checks for each in found] == [1, 1] and found[0].least == 0 < found[1].least
    assert table.row('heartbeats: 100 a second').group == 'heartbeat'


def test_every_requirement_of_the_list_is_used():
    code = ''.join(path.read_text() for path in FOLDER.glob('*.py')
                   if not path.name.startswith('test_'))
    assert [each.text for each in Table().rows
            if each.text not in code and 'no growth' not in each.text] == []


def test_each_scenario_has_to_run_to_its_end():
    table = Table()
    table.runs['exact'] = 1
    for text, number in (('every scenario runs to its end', [
            scenario for group in cli.GROUPS for scenario in group.scenarios]), (
                'what happened is in the log', [
                    event for group in cli.GROUPS for event in group.events])):
        assert table.row(text).least == len(number)
