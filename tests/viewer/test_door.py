"""Who may open the live page."""

import socket
import urllib.error
import urllib.request

import pytest
from shared import value_error

pytest.importorskip("viser", reason="needs the extra [viewer]")
from gaussian_swaying.viewer.screen import Door, check_address


def _open(address, **headers):
    """Status, headers and text of an answer."""
    try:
        answer = urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10)
    except urllib.error.HTTPError as error:
        answer = error
    return answer.status, answer.headers, answer.read().decode()


@pytest.fixture
def open_page(show):
    """A page that listens for other computers, too."""
    return show(host="0.0.0.0", names=["Wind.Example"])


def test_other_websites_in_the_same_browser_are_refused(page):
    """Neither by their own name, nor by one that they have pointed at this computer."""
    for headers in ({"Origin": "https://evil.example"}, {"Host": "evil.example"}, {"Host": "[1"}, {"Host": ""}):
        assert _open(page.url, **headers)[0] == 403
    assert _open(page.url, Origin=page.url)[0] == 200
    assert _open(f"{page.url}/{'a' * 5000}")[0] == 404  # a name that the system refuses
    assert page.url_elsewhere is None


def test_the_page_is_shown_in_no_frame(page):
    """And connects to its own server alone: viser would go to the address after `?websocket=`."""
    headers = _open(page.url)[1]
    assert headers["X-Frame-Options"] == "DENY"
    own = page.url.split("//")[1]
    policy = f"frame-ancestors 'none'; connect-src 'self' ws://{own} wss://{own} blob: data:"
    assert headers["Content-Security-Policy"] == policy


@pytest.mark.parametrize(
    ("name", "good"),
    [
        ("localhost:80", True),
        ("127.0.0.1", True),
        (socket.gethostname(), True),
        ("mine.example:8080", True),
        ("MINE.example", True),
        ("192.0.2.7:8080", True),
        ("192.0.2.8:8080", False),
        ("evil.example", False),
        ("mine.example.evil.example", False),
        ("0.0.0.0:8080", False),
        ("", False),
        ("[::1", False),
        ("user@localhost@evil.example", False),
    ],
)
def test_names_are_on_a_list(name, good):
    """Of this computer, of `--allow-host`, and the address at which the request arrived."""
    door = Door("0.0.0.0", ["Mine.example"])
    refusal = door.refusal(f"/?token={door.token}", {"Host": name}, "192.0.2.7", 8080)
    assert (refusal is None) is good
    assert (
        door.refusal(f"/?token={door.token}", {"Host": name, "Origin": "http://evil.example"}, "192.0.2.7") is not None
    )


def test_a_page_for_other_computers_needs_the_token_of_its_link(open_page, connect):
    address, token = open_page.url.split("/?token=")
    assert open_page.url_elsewhere == f"http://{socket.gethostname()}:{open_page.server.get_port()}/?token={token}"
    assert len(token) > 20
    assert Door("0.0.0.0").token != token
    assert "token" in _open(address)[2]
    assert (
        _open(address)[0] == _open(address + "/?token=" + token[:-1])[0] == _open(address + "/?token=%C3%A9")[0] == 403
    )
    status, headers, _ = _open(open_page.url)
    assert status == 200
    cookie = headers["Set-Cookie"].split(";")[0]
    assert {"HttpOnly", "SameSite=Strict"} <= {part.strip() for part in headers["Set-Cookie"].split(";")}
    assert _open(address, Cookie=cookie)[0] == 200
    assert _open(address, Cookie=cookie[:-1])[0] == _open(address, Cookie="=;;bad=")[0] == 403
    assert _open(open_page.url, Host="wind.example")[0] == 200
    assert _open(open_page.url, Host="evil.example")[0] == 403
    with pytest.raises(Exception, match="403"):
        connect(type("Page", (), {"url": address, "server": open_page.server}), wait=False)
    connect(open_page)
    connect(
        type("Page", (), {"url": address, "server": open_page.server}), additional_headers={"Cookie": f"a=b; {cookie}"}
    )


@pytest.mark.parametrize(("host", "port", "field"), [("127.0.0.1", 70000, "--port"), ("10.99.99.99", 8080, "--host")])
def test_an_address_that_cannot_be_is_refused(host, port, field):
    with value_error(field):
        check_address(host, port)


def test_noise_is_no_traceback(page, capfd):
    for noise in (b"\x16\x03\x01\x00garbage\r\n\r\n", b"GET\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", page.server.get_port()), timeout=5) as raw:
            raw.sendall(noise)
    assert _open(page.url)[0] == 200
    assert "Traceback" not in "".join(capfd.readouterr())


def test_the_link_works_in_a_browser(browser, open_page):
    """The websocket, which viser opens without the token, comes in by the cookie."""
    context = browser.new_context()
    window = context.new_page()
    window.goto(open_page.url)
    window.get_by_text("pictures a second").wait_for(timeout=60_000)
    context.close()
