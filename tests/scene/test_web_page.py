"""Pages fit the width of a phone."""

from pathlib import Path

import pytest

from illuminerf.scene.web_page import STYLE, web_page
from tests.viewer.browser import FOUND, Browser, wait_for

TABLE = "<table><tr>" + "".join(f"<th>heading{number}</th>" for number in range(12)) + "</tr></table>"


def test_tables_do_not_widen_the_page_on_a_phone(tmp_path: Path) -> None:
    if FOUND is None:
        pytest.skip("there is no Chromium")
    pytest.importorskip("websockets", reason="needs websockets")
    browser = Browser(390, 844)
    widths = {}
    for name, style in (("now", STYLE), ("before", STYLE.replace("overflow-x: auto", "").replace("block", "table"))):
        (tmp_path / f"{name}.html").write_bytes(web_page(name, TABLE, style))
        browser.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
        browser.call("Page.navigate", url=(tmp_path / f"{name}.html").as_uri())
        wait_for(lambda name=name: str(browser.evaluate("document.title")).startswith(name), 60)
        widths[name] = browser.evaluate("document.documentElement.scrollWidth")
    assert browser.errors == []
    browser.close()
    assert widths["now"] == 390 < widths["before"]
