"""The pages of the documentation, with their links, headings and blocks of commands."""
import re
from pathlib import Path
from typing import List, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'firmware' / 'README.md',
         *sorted((ROOT / 'doc').glob('*.md'))]

_FENCE = re.compile(r'^( *)```(\w*)[^\n]*\n(.*?)^\1```$', re.MULTILINE | re.DOTALL)
_MARK = re.compile(r'<!-- (.*?) -->\s*$')


class Block(NamedTuple):
    """A fenced block of a page."""

    page: Path
    line: int         # of its first fence
    language: str     # after its first fence
    mark: str         # the comment right before it, which tells how to run it
    text: str

    @property
    def id(self) -> str:
        """The id of a test."""
        return f'{self.page.relative_to(ROOT)}:{self.line}'


def blocks(page: Path) -> List[Block]:
    """Return every fenced block of a page, without its indentation."""
    text = page.read_text()
    found = []
    for match in _FENCE.finditer(text):
        indent, language, body = match.groups()
        before = text[:match.start()]
        mark = _MARK.search(before)
        found.append(Block(page, before.count('\n') + 1, language, mark.group(1) if mark else '',
                           re.sub(f'^{indent}', '', body, flags=re.MULTILINE)))
    return found


def links(page: Path) -> List[str]:
    """Return the targets of a page's links, except those to other hosts."""
    prose = re.sub(r'`[^`\n]*`', '', _FENCE.sub('', page.read_text()))
    return [link for link in re.findall(r'!?\[[^\]]*\]\(([^)\s]+)\)', prose) if '://' not in link]


def anchors(page: Path) -> List[str]:
    """Return the anchors of a page's headings, as GitHub generates them."""
    found: List[str] = []
    for heading in re.findall(r'^#+ +(.*)$', _FENCE.sub('', page.read_text()), re.MULTILINE):
        heading = re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', heading).strip().lower()
        slug = re.sub(r'[^\w\- ]', '', heading).replace(' ', '-')
        count = sum(1 for each in found if re.fullmatch(re.escape(slug) + r'(-\d+)?', each))
        found.append(f'{slug}-{count}' if count else slug)
    return found
