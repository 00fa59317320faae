"""Python 3.8 (Ubuntu 20.04) can run every file: no newer syntax or names are used.

A parser set to 3.8 accepts newer names and annotations, so the tests search for these, and for
names that pyserial 3.4, pytest 4.6 and hypothesis 4.36 do not have."""
import ast
from typing import Iterator

from sources import name, python_files

VERSION = (3, 8)

# Modules, attributes and imported names that these lack, and that this package hardly uses for its
# own. mypy knows all of Python's, but the tests have no types.
NEWER_NAMES = set('''
graphlib tomllib zoneinfo removeprefix removesuffix bit_count pairwise batched randbytes
is_relative_to hardlink_to with_stem pidfd_open pidfd_send_signal to_thread TaskGroup file_digest
unparse enterContext assertNoLogs get_annotations StrEnum ExceptionGroup BaseExceptionGroup UTC
add_note EncodingWarning Annotated ParamSpec Concatenate TypeAlias TypeGuard Self LiteralString
aclosing KW_ONLY PortNotOpenError function_scoped_fixture MonkeyPatch CaptureFixture
LogCaptureFixture FixtureRequest TempPathFactory ExceptionInfo Pytester StashKey
'''.split())
NEWER_FUNCTIONS = {('functools', 'cache'), ('math', 'lcm'), ('contextlib', 'chdir'),
                   ('asyncio', 'timeout'), ('hypothesis', 'target')}
NEWER_ARGUMENTS = {('zip', 'strict'), ('dataclass', 'slots'), ('dataclass', 'kw_only'),
                   ('Popen', 'process_group'), ('run', 'process_group')}

NOT_GENERIC = {'list', 'dict', 'tuple', 'set', 'frozenset', 'type', 'deque', 'defaultdict',
               'OrderedDict', 'Counter', 'Queue', 'SimpleQueue', 'Popen', 'CompletedProcess',
               'PathLike', 'partial'}


def too_new(text: str, filename: str = '') -> Iterator[str]:
    """Yield a line for each use of something newer."""
    try:
        tree = ast.parse(text, filename, feature_version=VERSION)
    except SyntaxError as error:
        yield '%s: %s' % (error.lineno, error.msg)
        return
    typed = {'%s[...]' % alias.name for node in ast.walk(tree) for alias in
             (node.names if isinstance(node, ast.ImportFrom) and node.module == 'typing' else ())}
    for node in ast.walk(tree):
        for what in _uses(node):
            if what not in typed:
                yield '%d: %s' % (node.lineno, what)


def _uses(node: ast.AST) -> Iterator[str]:
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        module = getattr(node, 'module', None) or ''
        yield from (alias.name for alias in node.names
                    if NEWER_NAMES & {alias.name.split('.')[0], module.split('.')[0]}
                    or (module, alias.name) in NEWER_FUNCTIONS)
    elif isinstance(node, ast.Attribute):
        owner = node.value.id if isinstance(node.value, ast.Name) else ''
        if node.attr in NEWER_NAMES or (owner, node.attr) in NEWER_FUNCTIONS:
            yield node.attr
    elif isinstance(node, ast.Subscript):
        if _last(node.value) in NOT_GENERIC and isinstance(node.ctx, ast.Load):
            yield '%s[...]' % _last(node.value)
    elif isinstance(node, ast.Call):
        yield from ('%s(%s=)' % (_last(node.func), keyword.arg) for keyword in node.keywords
                    if (_last(node.func), keyword.arg) in NEWER_ARGUMENTS)
    elif isinstance(node, (ast.arg, ast.AnnAssign)):
        yield from _unions(node.annotation)
    elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
        yield from _unions(node.returns)
        for decorator in node.decorator_list:
            if not isinstance(decorator, (ast.Name, ast.Attribute, ast.Call)):
                yield 'a decorator that is an expression'


def _last(node: ast.AST) -> str:
    return node.id if isinstance(node, ast.Name) else getattr(node, 'attr', '')


def _unions(annotation) -> Iterator[str]:
    if annotation is not None and any(isinstance(each, ast.BinOp) for each in
                                      ast.walk(annotation)):
        yield 'X | Y in an annotation'


def test_every_file_is_valid_for_python_3_8():
    assert [f'{name(path)}:{use}' for path in python_files()
            for use in too_new(path.read_text(), str(path))] == []
