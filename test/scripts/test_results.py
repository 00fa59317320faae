"""The count that scripts/test prints at its end."""
import pytest
import results

PYTEST = '''<testsuites><testsuite tests="4">
<testcase classname="test_a" name="green"/>
<testcase classname="test_a" name="skipped"><skipped message="no board"/></testcase>
<testcase classname="test_a" name="red"><failure message="assert 1 == 2">where</failure></testcase>
<testcase classname="test_a" name="broken"><error message="no fixture"/></testcase>
</testsuite></testsuites>'''
GREEN = '<testsuite><testcase classname="a" name="b"/></testsuite>'


@pytest.fixture
def program(tmp_path):
    """A function that makes the folder of a test program."""
    def make(name='part', status='0', log='', **files):
        folder = tmp_path / name
        folder.mkdir()
        (folder / 'status').write_text(status)
        (folder / 'log').write_text(log)
        for file, text in files.items():
            path = folder / (file.replace('__', '-') + '.xml')
            path.write_text(text)
        return folder
    return make


def test_each_kind_of_result_is_counted(program):
    found = results.of_program(program(status='1', results=PYTEST))
    assert (found.passed, found.skipped) == (1, [('test_a.skipped', 'no board')])
    assert found.failures == [('test_a.red', 'where'), ('test_a.broken', 'no fixture')]
    assert str(found) == '1 passed, 2 failed, 1 skipped'


def test_results_of_several_files_are_added(program):
    assert str(results.of_program(program(one=GREEN, two=GREEN))) == '2 passed, 0 failed'


def test_a_crash_without_results_is_a_failure_with_the_programs_name(program):
    found = results.of_program(program('links', '139', 'Segmentation fault'))
    (name, said), = found.failures
    assert name == 'links' and '139' in said and 'Segmentation fault' in said


def test_a_program_without_results_failed_even_with_status_0(program):
    assert str(results.of_program(program())) == '0 passed, 1 failed'


def test_a_crash_after_passed_tests_is_a_failure(program):
    assert str(results.of_program(program(status='124', one=GREEN))) == '1 passed, 1 failed'


@pytest.mark.parametrize('status, said', [('0', '1 passed, 0 failed'),
                                          ('3', '0 passed, 1 failed')])
def test_a_program_with_by_status_is_one_test(program, status, said):
    folder = program(status=status)
    (folder / 'by_status').touch()
    assert str(results.of_program(folder)) == said


def test_a_missing_status_is_a_failure(program):
    folder = program(one=GREEN)
    (folder / 'status').unlink()
    assert len(results.of_program(folder).failures) == 1


def test_invalid_xml_is_a_failure(program):
    assert str(results.of_program(program(one='<testsuite><testc'))) == '0 passed, 1 failed'


def test_programs_in_rostests_own_file_do_not_count_twice(program):
    assert str(results.of_program(program(
        rostest__all=GREEN, rosunit__bus=GREEN))) == '1 passed, 0 failed'


def test_a_rostest_program_without_result_counts_as_failed(program):
    wrap = ('<testsuite><testcase classname="r" name="testbus"><failure>test [bus] did not '
            'generate test results</failure></testcase></testsuite>')
    found = results.of_program(program(status='1', rostest__all=wrap))
    assert found.failures == [('r.testbus', 'test [bus] did not generate test results')]


def test_the_last_line_has_the_count_and_the_status_shows_failures(program, tmp_path, capsys):
    program('one', one=GREEN)
    assert results.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == '1 passed, 0 failed'
    program('two', status='1', two=PYTEST)
    assert results.main([str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == '2 passed, 2 failed, 1 skipped'
    assert '--- two: test_a.red' in lines
    assert 'skipped: two: test_a.skipped: no board' in lines


def test_no_program_at_all_is_a_failure(tmp_path):
    assert results.main([str(tmp_path)]) == 1
