"""A relay between two hosts that delays every byte: relay.py ADDRESS PORT TO DELAY_S."""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress


async def pass_on(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, delay_s: float
) -> None:
    """Write what is read, each piece after the delay."""
    clock = asyncio.get_running_loop()
    pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(1000)

    async def read() -> None:
        piece = b"-"
        while piece:
            with suppress(OSError):
                piece = b""
                piece = await reader.read(65536)
            await pieces.put((clock.time() + delay_s, piece))

    reading = asyncio.create_task(read())
    with suppress(OSError):
        while True:
            due_s, piece = await pieces.get()
            await asyncio.sleep(max(0.0, due_s - clock.time()))
            if not piece:
                break
            writer.write(piece)
            await writer.drain()
    reading.cancel()
    writer.close()


async def main(address: str, port: int, to: str, delay_s: float) -> None:
    """Relay all connections."""

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection(to, port)
        except OSError:
            writer.close()
            return
        await asyncio.gather(pass_on(reader, back, delay_s), pass_on(there, writer, delay_s))

    server = await asyncio.start_server(relay, address, port)
    await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], int(sys.argv[2]), sys.argv[3], float(sys.argv[4])))
