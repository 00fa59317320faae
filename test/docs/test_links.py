"""Every link in the pages has a target, and README and pages link to each other."""
import re

import pytest
from pages import PAGES, ROOT, anchors, prose

_LINK = re.compile(r'!?\[[^\]]*\]\(([^)\s]+)\)')


def links(page):
    """Return the targets of a page's links, except those to other hosts."""
    return [link for link in _LINK.findall(prose(page)) if '://' not in link]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_has_a_target(page):
    for link in links(page):
        path, _, anchor = link.partition('#')
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f'{link}: there is no such file'
        if anchor:
            assert anchor in anchors(target), f'{link}: there is no such heading'


def test_every_page_is_linked_from_the_readme_and_back():
    readme = ROOT / 'README.md'
    named = {(readme.parent / link.partition('#')[0]).resolve() for link in links(readme)}
    for page in PAGES:
        if page != readme:
            assert page in named, f'README.md does not name {page.name}'
            back = {(page.parent / link.partition('#')[0]).resolve() for link in links(page)}
            assert readme in back, f'{page.name} does not lead back to README.md'


def test_anchors_are_those_of_github(tmp_path):
    page = tmp_path / 'page.md'
    page.write_text('# mcu: STX … ETX\n## `code` and [a link](x.md)\n## Twice\n## Twice\n'
                    '```sh\n# no heading\n```\n')
    assert anchors(page) == ['mcu-stx--etx', 'code-and-a-link', 'twice', 'twice-1']


def test_the_readme_has_at_most_1300_words():
    assert len((ROOT / 'README.md').read_text().split()) <= 1300
