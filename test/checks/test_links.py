"""Every link in the pages has a target, and the README names every page."""
import pytest
from pages import PAGES, ROOT, anchors, links


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_has_a_target(page):
    for link in links(page):
        path, _, anchor = link.partition('#')
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f'{link}: there is no such file'
        if anchor:
            assert anchor in anchors(target), f'{link}: there is no such heading'


def test_every_page_is_linked_from_the_readme():
    named = {(ROOT / link.partition('#')[0]).resolve() for link in links(ROOT / 'README.md')}
    assert [page.name for page in PAGES[1:] if page not in named] == []
