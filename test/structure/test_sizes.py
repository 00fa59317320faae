"""No class of the bridge grows without bound."""
import ast
from pathlib import Path
from typing import Iterator, Set, Tuple

from sources import PACKAGE

BRIDGE = ('transport', 'framing', 'link', 'ros', 'boards')
MOST_ATTRIBUTES = 18      # assigned to self in the class
MOST_METHODS = 25         # properties included


def test_no_class_is_too_large():
    assert list(too_large(PACKAGE)) == []


def test_a_class_that_is_too_large_is_found(tmp_path):
    assigned = ['self.a0: int = 0', 'self.a1, (self.a2, other.b) = x', 'self.a3 += 1',
                *(f'self.a{number} = self.b{number}' for number in range(4, 18))]
    methods = '\n    '.join(f'def m{number}(self): pass' for number in range(24))
    text = 'class Large:\n    def m(self):\n        ' + '\n        '.join(assigned) + '\n    '
    for file, more in (('right', methods), ('attributes', methods + '\n        self.b = 1'),
                       ('methods', methods + '\n    @property\n    def more(self): pass')):
        (tmp_path / 'ros' / file).mkdir(parents=True)
        (tmp_path / 'ros' / file / 'module.py').write_text(text + more.replace(
            'pass\n        self.b', '\n        self.b').replace('Large', file))
        found = list(too_large(tmp_path))
        assert found == ([] if file == 'right' else ['Large'])
        (tmp_path / 'ros' / file / 'module.py').unlink()
    (tmp_path / 'boards').mkdir()
    (tmp_path / 'boards' / 'simulator.py').write_text(text + methods + '\n    def n(self): pass')
    assert list(too_large(tmp_path)) == [], 'no part of the bridge'


def too_large(package: Path) -> Iterator[str]:
    """Yield the name of each class with too many attributes or methods."""
    for folder in BRIDGE:
        for path in sorted((package / folder).rglob('*.py')):
            if path.name == 'simulator.py':
                continue
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ClassDef):
                    attributes, methods = sizes(node)
                    if len(attributes) > MOST_ATTRIBUTES or methods > MOST_METHODS:
                        yield node.name


def sizes(node: ast.ClassDef) -> Tuple[Set[str], int]:
    """Return the attributes that a class assigns to self, and the number of its methods."""
    attributes = {each.attr for each in ast.walk(node)
                  if isinstance(each, ast.Attribute) and isinstance(each.ctx, ast.Store)
                  and isinstance(each.value, ast.Name) and each.value.id == 'self'}
    return attributes, sum(isinstance(each, (ast.FunctionDef, ast.AsyncFunctionDef))
                           for each in node.body)
