import re
import shutil

import numpy as np
import pytest
from PIL import Image

from foundpose.visualization.report import Report, lines_chart, stacked_bars, write_report

CASES = [
    {"object": "cup", "image": "1/3", "reason": "mask", "error": None, "score": 0.25},
    {"object": "can", "image": "1/10", "reason": "mirrored", "error": 120.5, "score": 0.5},
    {"object": "<b>can</b>", "image": "1/2", "reason": "mirrored", "error": 9.0, "score": 0.75},
    {"object": "cup", "image": "2/1", "reason": "right", "error": 30.25, "score": 1},
]


def picture(size, seed):
    return Image.fromarray(np.random.default_rng(seed).integers(0, 255, (*size, 3), dtype=np.uint8))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    report = Report(
        title="Cups & cans",
        facts={"dataset": "kitchen </script>"},
        tables={"Average recall": [{"object": "all", "AR": 61.25}, {"object": "cup", "AR": None}]},
        charts={
            "Recall": lines_chart([0.1, 0.2], {"all": [0.3, 0.6], "cup": [0.1, 0.4]}, "threshold"),
            "Reasons": stacked_bars({"right": {"cup": 1, "can": 0}, "mask": {"cup": 1, "can": 2}}, "object"),
        },
        cases=CASES,
        thumbnails={k: picture((96, 96), k) for k in range(3)},
        figures={k: picture((300, 500), k) for k in range(2)},
    )
    write_report(path, report)
    return path


def test_the_file_stands_alone(page):
    text = page.read_text(encoding="utf-8")
    without_plotly = re.sub(r"<script>/\*\*.*?</script>", "", text, count=1, flags=re.DOTALL)
    assert len(without_plotly) < len(text) / 5
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", without_plotly)
    assert "kitchen &lt;/script&gt;" in text
    assert "Cups &amp; cans" in text
    assert text.count("data:image/webp;base64,") == 5


@pytest.fixture(scope="module")
def browser(page):
    """The page in a headless Chromium that may not use the network."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    chromium, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no chromium and chromedriver on the path")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "window-size=1300,1200"):
        options.add_argument(f"--{argument}")
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND")
    found = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    found.get(page.as_uri())
    yield found
    found.quit()


def column(browser, title):
    """What a column of the table shows."""
    heads = [cell.text.rstrip(" ▲▼") for cell in browser.find_elements("css selector", "#cases th")]
    lines = browser.find_elements("css selector", "#cases tbody tr")
    return [line.find_elements("css selector", "td")[heads.index(title)].text for line in lines]


def click_head(browser, title):
    next(
        c for c in browser.find_elements("css selector", "#cases th") if c.text.rstrip(" ▲▼") == title
    ).click()


def test_a_browser_shows_it_without_complaints(browser):
    assert browser.title == "Cups & cans"
    assert len(browser.find_elements("css selector", ".js-plotly-plot svg.main-svg")) >= 2
    assert column(browser, "object") == ["cup", "can", "<b>can</b>", "cup"]
    assert column(browser, "error") == ["–", "121", "9", "30.3"]
    assert [entry["message"] for entry in browser.get_log("browser")] == []


def test_columns_sort_by_number_and_by_word_and_what_lacks_comes_last(browser):
    click_head(browser, "error")
    assert column(browser, "error") == ["9", "30.3", "121", "–"]
    click_head(browser, "error")
    assert column(browser, "error") == ["121", "30.3", "9", "–"]
    click_head(browser, "image")
    assert column(browser, "image") == ["1/2", "1/3", "1/10", "2/1"]


def test_rows_are_filtered_by_choice_and_by_search(browser):
    choice = browser.find_element("css selector", "select[name=reason]")
    browser.execute_script("arguments[0].value = 'mirrored'; arguments[0].onchange()", choice)
    assert set(column(browser, "reason")) == {"mirrored"}
    assert browser.find_element("id", "count").text == "2 of 4"
    browser.find_element("id", "search").send_keys("1/10")
    assert column(browser, "image") == ["1/10"]
    browser.execute_script("arguments[0].value = ''; arguments[0].onchange()", choice)
    browser.execute_script("const s = document.getElementById('search'); s.value = ''; s.oninput()")
    assert len(column(browser, "image")) == 4
    assert browser.find_elements("css selector", "select[name=error]") == []


def test_a_click_opens_the_figure_and_arrow_keys_go_on(browser):
    line = browser.find_element("css selector", "tr[data-place='0']")
    browser.execute_script("arguments[0].scrollIntoView(); arguments[0].click()", line)
    shown = browser.find_element("css selector", "dialog img")
    assert shown.is_displayed()
    assert shown.get_property("naturalWidth") == 500
    first = shown.get_attribute("src")
    event = "document.dispatchEvent(new KeyboardEvent('keydown', {key: arguments[0]}))"
    order = [line.get_attribute("data-place") for line in browser.find_elements("css selector", "tr.opens")]
    browser.execute_script(event, "ArrowRight" if order.index("0") == 0 else "ArrowLeft")
    assert shown.get_attribute("src") != first
    assert [entry["message"] for entry in browser.get_log("browser")] == []
