"""Whether two sweeps have the same results, to the last bit."""

from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight


def same_results(first, second):
    """All of two sweeps but the measured times and what says when, to the last bit."""
    assert [row["key"] for row in first.rows] == [row["key"] for row in second.rows]
    for a, b in zip(first.rows, second.rows, strict=True):
        assert _settled(a) == _settled(b)
        flights = [read_flight(CellStore(result.out).path(a["key"])) for result in (first, second)]
        assert list(flights[0].columns) == list(flights[1].columns)
        for name in flights[0].columns:
            if name != "solve_time":
                assert flights[0][name].tobytes() == flights[1][name].tobytes(), name
        records = [flight.metadata for flight in flights]
        for record in records:
            record["row"] = _settled(record["row"])
            del record["provenance"]["created"], record["provenance"]["git"]  # files may change while tests run
        assert records[0] == records[1]


def _settled(row):
    return {name: value for name, value in row.items() if not name.startswith("solve_time")}
