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
WRAPPED = ('<testsuite><testcase classname="r" name="testbus"><failure>test [bus] did not generate '
           'test results</failure></testcase></testsuite>')


@pytest.fixture
def program(tmp_path):
    """A function that makes the folder of a test program."""
    def make(status, name='part', **files):
        folder = tmp_path / name
        folder.mkdir()
        if status is not None:
            (folder / 'status').write_text(status)
        (folder / 'log').write_text('Segmentation fault')
        for file, text in files.items():
            name = file if file == 'by_status' else file.replace('__', '-') + '.xml'
            (folder / name).write_text(text)
        return folder
    return make


@pytest.mark.parametrize('status, files, said', [
    ('1', {'results': PYTEST}, '1 passed, 2 failed, 1 skipped'),
    ('0', {'one': GREEN, 'two': GREEN}, '2 passed, 0 failed'),
    ('0', {}, '0 passed, 1 failed'),
    ('124', {'one': GREEN}, '1 passed, 1 failed'),
    ('0', {'by_status': ''}, '1 passed, 0 failed'),
    ('3', {'by_status': ''}, '0 passed, 1 failed'),
    (None, {'one': GREEN}, '1 passed, 1 failed'),
    ('0', {'one': '<testsuite><testc'}, '0 passed, 1 failed'),
    ('0', {'rostest__all': GREEN, 'rosunit__bus': GREEN}, '1 passed, 0 failed'),
    ('1', {'rostest__all': WRAPPED}, '0 passed, 1 failed')],
    ids=['each kind', 'several files', 'no results', 'a crash after passed tests', 'by status',
         'by status, failed', 'no status', 'invalid XML', "rostest's own file counts once",
         'a rostest program without results'])
def test_results_are_counted(program, status, files, said):
    assert str(results.of_program(program(status, **files))) == said


def test_failures_and_skipped_tests_are_named(program):
    found = results.of_program(program('1', results=PYTEST))
    assert found.skipped == [('test_a.skipped', 'no board')]
    assert found.failures == [('test_a.red', 'where'), ('test_a.broken', 'no fixture')]
    (name, said), = results.of_program(program('139', 'links')).failures
    assert name == 'links' and '139' in said and 'Segmentation fault' in said
    assert results.of_program(program('1', 'ros', rostest__all=WRAPPED)).failures == [
        ('r.testbus', 'test [bus] did not generate test results')]


def test_the_last_line_has_the_count_and_the_status_shows_failures(program, tmp_path, capsys):
    assert results.main([str(tmp_path)]) == 1, 'no program at all'
    program('0', 'one', one=GREEN)
    assert results.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == '1 passed, 0 failed'
    program('1', 'two', two=PYTEST)
    assert results.main([str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == '2 passed, 2 failed, 1 skipped'
    assert '--- two: test_a.red' in lines
    assert 'skipped: two: test_a.skipped: no board' in lines
