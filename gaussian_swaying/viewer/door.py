"""Access to the live page: checks of the requested host name, of the website that asks, and of the token."""

from __future__ import annotations

import hmac
import http
import secrets
import socket
from collections.abc import Mapping, Sequence
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

LOCAL = ("127.0.0.1", "localhost", "::1")
ANY = ("0.0.0.0", "::", "")


def check_address(host: str, port: int) -> None:
    """Raise ValueError if nothing can listen at an address."""
    if not 0 < port < 65536:
        raise ValueError(f"Expected `--port` from 1 to 65535, but got {port}.")
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise ValueError(
            f"Nothing can listen at `--host` {host} ({error.strerror or error}): give an address of this computer, "
            "such as 127.0.0.1."
        ) from None


class Door:
    """Checks requests before the server answers them, and adds headers to its answers.

    A page that other computers can reach has a token in its link. The first answer keeps it as a cookie, as the
    websocket of viser asks without it.

    Args:
        host: Address at which the server listens.
        names: Names of this computer that a browser may ask for, besides those that it has.

    Attributes:
        token: The token that a link needs; None if the server listens on this computer only.
    """

    def __init__(self, host: str, names: Sequence[str] = ()) -> None:
        own = [] if host in LOCAL else [host, socket.gethostname(), f"{socket.gethostname()}.local"]
        self.names = {name.lower() for name in (*LOCAL, *own, *names)} - set(ANY)
        self.token = None if host in LOCAL else secrets.token_urlsafe(16)

    def refusal(self, path: str, headers: Mapping[str, str], address: str = "", port: int = 0) -> str | None:
        """Return the reason why a request is refused, or None.

        Args:
            path: The requested path, with the query.
            headers: Of the request.
            address: Address of this computer at which the request arrived.
            port: Port of the server.
        """
        asked, origin = headers.get("Host") or "", headers.get("Origin")
        try:
            name = urlsplit(f"//{asked}").hostname or ""
            other = origin is not None and urlsplit(origin).netloc != asked
        except ValueError:
            return "The request is not valid."
        if name not in self.names and not (self.token and name == address):
            return f"This page does not go by the name {name[:100]!r}: start it with `--allow-host` and that name."
        if other:
            return "This is for pages of this program only."
        if self.token and not any(
            hmac.compare_digest(given.encode(), self.token.encode()) for given in _tokens(path, headers, port)
        ):
            return "The link lacks its token: open the whole link that the program has printed."
        return None

    def answer(self, process_request: Any, connection: Any, request: Any) -> Any:
        """Return viser's answer to an allowed request, with headers that forbid frames and connections elsewhere."""
        address, port = connection.local_address[:2]
        refused = self.refusal(request.path, request.headers, address, port)
        if refused is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refused}\n")
        try:
            response = process_request(connection, request)
        except OSError:  # such as a name that is too long
            return connection.respond(http.HTTPStatus.NOT_FOUND, "NOT FOUND")
        if response is not None:
            own = request.headers["Host"]
            response.headers["Content-Security-Policy"] = (
                f"frame-ancestors 'none'; connect-src 'self' ws://{own} wss://{own} blob: data:"
            )
            response.headers["X-Frame-Options"] = "DENY"
            response.headers["X-Content-Type-Options"] = "nosniff"
            response.headers["Referrer-Policy"] = "no-referrer"
            if self.token:
                response.headers["Set-Cookie"] = f"wind-{port}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return response


def _tokens(path: str, headers: Mapping[str, str], port: int) -> list[str]:
    found = parse_qs(urlsplit(path).query).get("token", [])
    try:
        cookie = SimpleCookie(headers.get("Cookie") or "").get(f"wind-{port}")
    except CookieError:
        cookie = None
    return [*found, *([] if cookie is None else [cookie.value])]
