"""Each promise of doc/reliability.md names the requirements and tests that check it."""
import re

from pages import ROOT

PAGE = (ROOT / 'doc' / 'reliability.md').read_text()
SECTIONS = ('The motor', 'Old commands', 'The bus', 'Data', 'The node', 'The page',
            'The reference boards')


def section(title):
    """The text of a section, without its subsections."""
    return re.search(rf'^#+ {title}\n(.*?)(?=^#)', PAGE, re.MULTILINE | re.DOTALL).group(1)


def rows():
    """The rows of the table: the promise, and what tests it."""
    table = section('What tests each promise')
    return re.findall(r'^\| (.*?) … \| (.*?) \|$', table, re.MULTILINE)


def test_every_promise_has_a_row_and_every_row_a_promise():
    promises = [f'{title}: {text.replace("**", "")}' for title in SECTIONS
                for text in re.findall(r'^- (.*)$', section(title), re.MULTILINE)]
    names = [name for name, _ in rows()]
    assert len(names) == len(promises)
    for name, promise in zip(names, promises):
        assert promise.startswith(name)


def test_every_requirement_and_test_in_the_table_exists():
    tests = {name for path in (ROOT / 'test').rglob('*.py')
             for name in re.findall(r'def (test_\w+)', path.read_text())}
    listed = {line.split(None, 1)[1] for line in
              (ROOT / 'test' / 'campaign' / 'rows.txt').read_text().splitlines() if line[0] == ' '}
    for promise, checks in rows():
        requirements, names = re.findall(r'"(.*?)"', checks), re.findall(r'`(\w+)`', checks)
        assert requirements or names, promise
        assert [text for text in requirements if text not in listed] == []
        assert [name for name in names if name not in tests] == []
