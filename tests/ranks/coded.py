"""Run on two ranks by test_compression.py: a link is measured, messages cross coded, a damaged one is refused."""

import numpy as np
import pytest
from splatpipe.cluster.compression import add_links, measure_link, start_coding
from splatpipe.cluster.transport import Transport
from splatpipe.shared.config import PipelineSection
from splatpipe.shared.errors import MessageError
from splatpipe.shared.messages import RENDER_POINT, Kind, RenderPoints, VisibilityBits, decode_render_points, header

transport = Transport(timeout_s=20)
other = 1 - transport.rank

found = measure_link(transport, other, 20e-3, serve=transport.rank == 0)
assert 1e6 < found[0] < 1e12
assert 0 < found[1] < 1
assert len(set(transport.join(np.array(found)).tolist())) == 2, "both ranks found the same"

asked = PipelineSection(topology="sort-last-only", compression=("off", "on")[transport.rank])
assert start_coding(transport, asked) is None, "the most careful setting holds"
asked = PipelineSection(topology="sort-last-only", compression="auto")
transport.coding = start_coding(transport, asked)
entries = np.zeros(5000, RENDER_POINT)
entries["offset"], entries["range"], entries["stride"] = 20 * np.arange(5000), 10, 1
for setting in ("auto", "on"):
    transport.coding = start_coding(transport, PipelineSection(topology="sort-last-only", compression=setting))
    assert transport.traffic() == {}, "what was measured is no message of the run"
    transport.send(other, RenderPoints(1, entries))
    transport.send(other, VisibilityBits(1, 80, np.zeros(10, np.uint8)))
    got = decode_render_points(*transport.receive(other, Kind.RENDER_POINTS, entries.nbytes))
    assert np.array_equal(got.entries, entries), setting
    assert transport.receive(other, Kind.VISIBILITY, 10).payload.tobytes() == bytes(10)
    result = add_links(transport, {"messages": transport.traffic()} if transport.rank == 0 else None)
    assert (result is None) == (transport.rank == 1)
    if result is not None:
        assert [(link["sender"], link["receiver"]) for link in result["links"]] == [(0, 1), (1, 0)]
        for link in result["links"]:
            counts = link["kinds"]["RENDER_POINTS"]
            assert (counts["messages"], counts["raw_bytes"]) == (1, 80_000)
            assert ("raw" in counts["forms"]) == (setting == "auto")
            assert link["shared_memory"]
            assert counts["why"].startswith("raw" if setting == "auto" else "pipeline.compression is on")
        sent = result["messages"]["RENDER_POINTS"]
        assert ("raw_bytes" in sent) == (setting == "on")
        assert sent["bytes"] == 80_024 if setting == "auto" else sent["bytes"] < 20_000

damaged = memoryview(b"V" + bytes(30))
transport._post(other, header(Kind.RENDER_POINTS, 1, len(damaged), coded=True), damaged)
with pytest.raises(MessageError, match="coded RENDER_POINTS message"):
    transport.receive(other, Kind.RENDER_POINTS, 1000)
transport.finish()
print(f"rank {transport.rank} done", flush=True)
