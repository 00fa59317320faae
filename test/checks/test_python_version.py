"""Python 3.8 (Ubuntu 20.04) can run every file: no newer syntax or names are used.

mypy knows all of Python's names, but tests have no types; and neither knows what pyserial 3.4,
pytest 4.6 and hypothesis 4.36 lack. So these names are searched for.
"""
import ast

from sources import name, python_files

VERSION = (3, 8)
# Modules, attributes and imported names that this package hardly uses for its own.
NEWER = set('''
graphlib tomllib zoneinfo removeprefix removesuffix bit_count pairwise batched randbytes
is_relative_to hardlink_to with_stem pidfd_open pidfd_send_signal to_thread TaskGroup file_digest
unparse enterContext assertNoLogs get_annotations StrEnum ExceptionGroup BaseExceptionGroup UTC
add_note EncodingWarning Annotated ParamSpec Concatenate TypeAlias TypeGuard Self LiteralString
aclosing KW_ONLY PortNotOpenError function_scoped_fixture MonkeyPatch CaptureFixture
LogCaptureFixture FixtureRequest TempPathFactory ExceptionInfo Pytester StashKey functools.cache
math.lcm contextlib.chdir asyncio.timeout hypothesis.target
'''.split())


def names(node):
    """The names in a node, alone and after their module or owner."""
    if isinstance(node, ast.Attribute):
        owner = node.value.id if isinstance(node.value, ast.Name) else ''
        return {node.attr, f'{owner}.{node.attr}'}
    if isinstance(node, ast.ImportFrom):
        return {node.module, *(each for alias in node.names
                               for each in (alias.name, f'{node.module}.{alias.name}'))}
    return {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()


def test_every_file_is_valid_for_python_3_8():
    assert [f'{name(path)}:{node.lineno}: {sorted(names(node) & NEWER)}' for path in python_files()
            for node in ast.walk(ast.parse(path.read_text(), str(path), feature_version=VERSION))
            if names(node) & NEWER] == []
