"""doc/troubleshooting.md quotes log lines and errors as they are in the code."""
import ast
import itertools
import os
import re
import subprocess
import sys

import pytest
from pages import ROOT

_HEADING = '## What the log says'


def quotes(page):
    """The quoted texts in the first column of the table of log lines."""
    table = page.partition(f'{_HEADING}\n')[2].partition('\n## ')[0]
    _header, *rows = [line.split('|')[1] for line in table.splitlines() if line.startswith('| ')]
    assert all('`' in row for row in rows), rows
    return [quote for row in rows for quote in re.findall('`([^`]*)`', row)]


def texts(source):
    """Every string in Python code but the docstrings, with … for each value in it."""
    tree = ast.parse(source)
    left_out = {id(part) for node in ast.walk(tree) for part in (
        [node.value] if isinstance(node, ast.Expr)              # a docstring, or no string
        else node.values if isinstance(node, ast.JoinedStr) else [])}
    return [text for node in ast.walk(tree) if id(node) not in left_out for text in versions(node)]


def versions(node):
    """The texts that an expression may have: several if an f-string chooses between constants."""
    if isinstance(node, ast.JoinedStr):
        parts = [versions(part) or ['…'] for part in node.values]
        return [''.join(each) for each in itertools.product(*parts)]
    if isinstance(node, ast.FormattedValue):
        node = node.value
        return versions(node.body) + versions(node.orelse) if isinstance(node, ast.IfExp) else []
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [re.sub('%[sdrg]', '…', node.value)]
    return []


PAGE = (ROOT / 'doc' / 'troubleshooting.md').read_text()
TEXTS = [text for path in sorted((ROOT / 'serial_communication').rglob('*.py'))
         for text in texts(path.read_text())]


@pytest.mark.parametrize('quote', quotes(PAGE))
def test_every_quoted_line_is_in_the_code(quote):
    assert any(quote.strip('…') in text for text in TEXTS), f'no text in the code has: {quote}'


def test_texts_of_code_have_placeholders_for_values_and_no_docstrings():
    assert sorted(texts('"""A docstring."""\n'
                        'warn(f"speed {speed} is {\'over\' if high else \'under\'} it: {why}")\n'
                        'warn("no answer from %s", name)\n')) == sorted([
                            'speed … is over it: …', 'speed … is under it: …', 'no answer from …',
                            'over', 'under'])


def test_a_script_beside_a_clone_gets_the_error_that_the_page_has(tmp_path):
    (tmp_path / 'serial_communication' / 'msg').mkdir(parents=True)
    done = subprocess.run(
        [sys.executable, '-c', 'from serial_communication.msg import Ticks'], cwd=str(tmp_path),
        env={'PATH': os.environ['PATH']}, stderr=subprocess.PIPE, text=True, timeout=60)
    error = done.stderr.splitlines()[-1].partition(': ')[2].replace("'Ticks'", '…')
    assert f'`{error}`' in PAGE
