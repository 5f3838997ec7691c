from fractions import Fraction

import pytest

from lae_sim.errors import LaeError
from lae_sim.importers.given import given_times


def write(path, text):
    path.write_text(text, "utf-8")


@pytest.mark.parametrize(
    ("text", "source", "ns"),
    [
        ("constant:47ms", "constant 47 ms, not measured", 47_000_000),
        ("constant:0.1s", "constant 0.1 s, not measured", 100_000_000),
        ("mean-fps:120.3", "mean fps 120.3 given, not measured per frame", 8_312_552),
        ("mean-fps:30000/1001", "mean fps 30000/1001 given, not measured per frame", 33_366_667),
        ("mean-fps:3", "mean fps 3 given, not measured per frame", 333_333_333),
    ],
)
def test_given_times(text, source, ns):
    given = given_times(text, "any")
    assert (given.source, given.of("a", 3)) == (source, ns)


def test_given_times_may_tell_the_initialisation_apart(tmp_path):
    path = tmp_path / "of,all.csv"
    write(path, "sequence,fps\na,300\n")
    for text, source, ns in (
        ("constant:47ms", "constant 47 ms, initialisation 800 ms, not measured", 47_000_000),
        (
            "mean-fps:120.3",
            "mean fps 120.3 given, initialisation 800 ms, not measured per frame",
            8_312_552,
        ),
        (
            f"mean-fps:{path}",
            "mean fps of each sequence from of,all.csv, initialisation 800 ms, not measured per "
            "frame",
            3_333_333,
        ),
    ):
        given = given_times(f"{text},init=0.8s", "any")
        assert (given.source, given.of("a", 3)) == (source, ns)
        assert given.init_ns == 800_000_000
        assert given_times(text, "any").init_ns is None


def test_measured_times_are_not_given():
    assert given_times("measured", "any") is None
    for text in ("constant:47", "constant:", "mean-fps:0", "mean-fps:", "fast", "measured:1",
                 "constant:47ms,init=", "constant:47ms,800ms", "mean-fps:120,init=-1s",
                 "mean-fps:120,30", "mean-fps:1000000000.1"):  # fmt: skip
        with pytest.raises(LaeError):
            given_times(text, "any")


def test_mean_fps_file(tmp_path):
    path = tmp_path / "fps.csv"
    write(path, "tracker,sequence,frames,fps\nKCF,a,2,300\nKCF,b,,0.7441\nECO,a,2,30\n")
    given = given_times(f"mean-fps:{path}", "KCF")
    assert given.source == "mean fps of each sequence from fps.csv, not measured per frame"
    assert given.of("a", 2) == 3_333_333
    assert given.of("b", 99) == round(Fraction(10**13, 7441))
    with pytest.raises(LaeError, match="'a' has 2 frames there and 3 here"):
        given.of("a", 3)
    with pytest.raises(LaeError, match=r"fps\.csv: no row for sequence 'c'"):
        given.of("c", 3)
    with pytest.raises(
        LaeError, match="has ECO, KCF, not 'SRDCF'; if it is there under another name"
    ):
        given_times(f"mean-fps:{path}", "SRDCF")
    write(path, "sequence,fps\na,20\nb,20\na,30\n")
    with pytest.raises(LaeError, match="line 4: a second row for 'a'"):
        given_times(f"mean-fps:{path}", "any")
    write(path, "sequence,fps\na,25\n")
    assert given_times(f"mean-fps:{path}", "any").of("a", 7) == 40_000_000


def test_mean_fps_of_trackers(tmp_path):
    path = tmp_path / "fps.csv"
    write(path, "tracker,fps\nKCF,250\nECO,25\n")
    given = given_times(f"mean-fps:{path}", "ECO")
    assert given.source == "mean fps of the tracker from fps.csv, not measured per frame"
    assert (given.of("a", 2), given.of("b", 3)) == (40_000_000, 40_000_000)
    with pytest.raises(LaeError, match=r"not 'SRDCF'.* add its rate or give --time mean-fps:120"):
        given_times(f"mean-fps:{path}", "SRDCF")
    write(path, "tracker,fps\nKCF,250\nKCF,25\n")
    with pytest.raises(LaeError, match="line 3: a second row for 'KCF'"):
        given_times(f"mean-fps:{path}", "KCF")
    write(path, "tracker;fps\nKCF;250\n")
    with pytest.raises(LaeError, match="tracker and fps, separated by commas"):
        given_times(f"mean-fps:{path}", "KCF")


@pytest.mark.parametrize(
    "text", ["", "a,b\n1,2\n", "sequence,fps\na,fast\n", "sequence,fps\na\n", "sequence,fps\na,0\n"]
)
def test_damaged_mean_fps_file(tmp_path, text):
    write(tmp_path / "fps.csv", text)
    with pytest.raises(LaeError, match=r"fps\.csv"):
        given_times(f"mean-fps:{tmp_path / 'fps.csv'}", "any")
