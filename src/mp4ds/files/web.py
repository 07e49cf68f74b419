"""Ranges of files on web servers: no more than requested, whatever these send."""

from __future__ import annotations

from typing import Any

from fsspec.implementations.http import HTTPFileSystem

from mp4ds.errors import Refused


class RangeFileSystem(HTTPFileSystem):  # type: ignore[misc]
    """fsspec's file system, which reads whatever comes, limited to ranges."""

    async def _cat_file(self, url: str, start: int = 0, end: int = 0, **kwargs: Any) -> bytes:
        """A range; one byte more if the server sends more.

        Raises:
            Refused: The server does not support ranges.
        """
        options = {**self.kwargs, **kwargs}
        headers = {
            **options.pop("headers", {}),
            "Range": f"bytes={start}-{end - 1}",
            "Accept-Encoding": "identity",
        }
        session = await self.set_session()
        async with session.get(self.encode_url(url), headers=headers, **options) as response:
            self._raise_not_found_for_status(response, url)
            if response.status != 206 and start > 0:
                raise Refused("the web server does not support range requests")
            data = bytearray()
            while missing := end - start + 1 - len(data):
                piece = await response.content.read(missing)
                if not piece:
                    break
                data += piece
            return bytes(data)
