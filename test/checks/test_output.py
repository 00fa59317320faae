"""Output of a program arrives in a file or a pipe line by line, while the program still runs."""
import os
import select
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import PATIENCE

ROOT = Path(__file__).resolve().parents[2]
_PRINTS = '''
import sys
from serial_communication.output import prepare_output
prepare_output()
print('a line', file=sys.{stream})
sys.stdin.read()
'''


def python(code, *arguments, **options):
    """Run Python code in an environment like that of a user's shell."""
    environment = dict(os.environ)
    environment.pop('PYTHONUNBUFFERED', None)
    environment['PYTHONPATH'] = f'{ROOT}:{environment.get("PYTHONPATH", "")}'
    return subprocess.Popen([sys.executable, '-c', code, *arguments], env=environment,
                            stderr=subprocess.STDOUT, universal_newlines=True, **options)


@pytest.mark.parametrize('stream', ['stdout', 'stderr'])
def test_a_line_arrives_before_the_program_ends(stream):
    with python(_PRINTS.format(stream=stream), stdin=subprocess.PIPE,
                stdout=subprocess.PIPE) as program:
        try:
            assert select.select([program.stdout], [], [], PATIENCE)[0], 'nothing has arrived'
            assert program.stdout.readline() == 'a line\n'
            assert program.poll() is None
        finally:
            program.stdin.close()


def test_closed_standard_streams_cause_no_error():
    done = python('import os; os.close(1); os.close(2)\n'
                  f'os.execv({sys.executable!r}, ["python3", "-c", """{_PRINTS}"""])'.replace(
                      "print('a line', file=sys.{stream})", ''), stdin=subprocess.DEVNULL)
    assert done.wait(60) == 0
