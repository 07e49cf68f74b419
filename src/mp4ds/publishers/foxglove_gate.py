"""Who may come to the Foxglove server: the SDK lets in web pages of any origin.

The SDK's own port takes TLS only, with a certificate that is made for the run, which no browser
trusts. What clients connect to is the gate, which looks at the origin first.
"""

from __future__ import annotations

import asyncio
import datetime
import io
import socket
import ssl
import threading
from collections.abc import Sequence
from contextlib import suppress
from http.client import HTTPException, parse_headers
from urllib.parse import urlsplit

FOXGLOVE_ORIGIN = "https://app.foxglove.dev"

_LOOPBACK = "127.0.0.1"
_LOOPBACK_NAMES = ("localhost", _LOOPBACK, "::1")
_NAME = "mp4ds"  # in the certificate
_HEAD_S = 10.0
_BLOCK = 1 << 18
_FLUSH_S = 0.5
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


def is_welcome(origin: str | None, allowed: Sequence[str]) -> bool:
    """Whether a client may connect.

    Args:
        origin: The header ``Origin`` of its request: browsers always send it.
        allowed: Origins of web sites that may, besides those of this machine.
    """
    if origin is None or origin in allowed:
        return True
    try:
        parts = urlsplit(origin)
        host = parts.hostname
    except ValueError:
        return False
    if parts.scheme in ("http", "https"):
        return host in _LOOPBACK_NAMES
    return bool(parts.scheme)  # of a program, such as file: ; that of a framed page is "null"


class Gate:
    """Passes on what welcome clients and the SDK's server say to each other.

    What waits for a slow client is bounded: the server is not read while a client takes nothing.

    Args:
        host: Address of this machine to listen on.
        port: Port to listen on; 0 picks a free one.
        origins: Origins of web sites that may connect, besides those of this machine.

    Attributes:
        port: That it listens on.
        certificate: For the server, PEM.
        key: For the server, PEM.

    Raises:
        OSError: It cannot listen there.
        ImportError: The package cryptography is missing.
    """

    def __init__(self, host: str, port: int, origins: Sequence[str]) -> None:
        self._origins = origins
        self.certificate, self.key = _certificate()
        self._tls = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._tls.load_verify_locations(cadata=self.certificate.decode())
        self._listener = _listener(host, port)
        self.port: int = self._listener.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._ending = asyncio.Event()
        self._visits: set[asyncio.Task[None]] = set()
        self._thread: threading.Thread | None = None

    def open(self, server_port: int) -> None:
        """Let clients in.

        Args:
            server_port: Of the SDK's server, on the loopback.
        """
        self._server_port = server_port
        self._thread = threading.Thread(target=self._run, name="foxglove gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End all connections; what a client has not taken 0.5 s later is dropped."""
        if self._thread is None:
            self._listener.close()
            self._loop.close()
            return
        self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join()
        self._thread = None

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._visit, sock=self._listener)
        await self._ending.wait()
        server.close()
        if self._visits:
            _, left = await asyncio.wait(self._visits, timeout=_FLUSH_S)
            for visit in left:
                visit.cancel()
            await asyncio.gather(*left, return_exceptions=True)

    async def _visit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is not None:
            self._visits.add(task)
            task.add_done_callback(self._visits.discard)
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_S)
            if not self._is_welcome(head):
                writer.write(_REFUSED)
            else:
                await self._pass_on(head, reader, writer)
            writer.close()
            await writer.wait_closed()
        except (OSError, EOFError, asyncio.LimitOverrunError, asyncio.TimeoutError):
            pass  # it went away, or is no client
        finally:
            writer.transport.abort()

    def _is_welcome(self, head: bytes) -> bool:
        try:
            origins = parse_headers(io.BytesIO(head.partition(b"\r\n")[2])).get_all("Origin", [])
        except HTTPException:
            return False
        return all(is_welcome(origin, self._origins) for origin in origins)

    async def _pass_on(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        from_server, to_server = await asyncio.open_connection(
            _LOOPBACK, self._server_port, ssl=self._tls, server_hostname=_NAME
        )
        to_server.write(head)
        ways = [
            asyncio.ensure_future(_pump(reader, to_server)),
            asyncio.ensure_future(_pump(from_server, writer)),
        ]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            to_server.transport.abort()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_BLOCK):
            writer.write(data)
            await writer.drain()


def _listener(host: str, port: int) -> socket.socket:
    family, *_, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
    return socket.create_server(address[:2], family=family, dualstack_ipv6=both)


def _certificate() -> tuple[bytes, bytes]:
    """A certificate that nobody trusts, and its key: both PEM."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, _NAME)])
    # for ever: it lives as long as this process, and clocks may be wrong
    begin, end = (datetime.datetime(year, 1, 1) for year in (2000, 2200))
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(end)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(_NAME)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    form = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    pem = serialization.Encoding.PEM
    return certificate.public_bytes(pem), key.private_bytes(pem, *form)
