"""Pages in a real browser as wide as a phone."""

import base64
from collections.abc import Iterator

import pytest

from aqualvs.report import html
from browser import Page, open_page

PHONE_PX = (390, 844)
# A grey picture of one pixel, as wide as its style says.
PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGOoBwAAgQCAyPzXwgAAAABJRU5ErkJggg=="
)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    folder = tmp_path_factory.mktemp("phone")
    facts = [("jumps of the thrusters above 0.25 a minute", "horizontal 0, yaw 18")] * 3
    content = {
        "title": "hold",
        "subtitle": "",
        "cards": html.cards([html.Card("range", "600 mm", "median")] * 7),
        "warnings": html.notice([]),
        "facts": html.Raw(
            html.fact_table(facts) + html.table(["a head of several words"] * 7, [["1,234"] * 7])
        ),
        "figures": [(html.data_url(PIXEL, "png"), "")],
    }
    path = folder / "page.html"
    path.write_text(html.page("follow.html", content), encoding="utf-8")
    with open_page(folder / "profile") as shown:
        shown.size(*PHONE_PX)
        shown.call("Page.navigate", url=path.as_uri())
        shown.wait_for("document.readyState === 'complete' && !!document.querySelector('.facts')")
        yield shown


def measured(page: Page, selector: str, what: str) -> float:
    return float(page.evaluate(f"document.querySelector('{selector}').{what}"))


def test_the_page_itself_does_not_scroll_sideways(page: Page) -> None:
    assert measured(page, "html", "scrollWidth") <= PHONE_PX[0]


def test_values_of_facts_have_room_for_words(page: Page) -> None:
    assert measured(page, ".facts td:last-child", "offsetWidth") > PHONE_PX[0] / 3
    assert measured(page, ".facts tr", "offsetHeight") < 100


def test_heads_of_wide_tables_stay_on_one_line(page: Page) -> None:
    assert measured(page, "#numbers th", "offsetHeight") < 40
    assert measured(page, "#numbers .scroll + .scroll", "scrollWidth") > PHONE_PX[0]


def test_charts_keep_their_scale_and_move_inside_the_page(page: Page) -> None:
    assert measured(page, "figure img", "offsetWidth") == 640
    assert measured(page, "figure", "offsetWidth") < PHONE_PX[0]
