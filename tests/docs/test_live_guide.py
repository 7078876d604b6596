"""The guide to the live filter: its cells run, and what it says is refused is refused."""

from snippets import ROOT, cells, run_cells

GUIDE = ROOT / "docs" / "guides" / "live.md"


def test_its_cells_run_and_refuse_what_is_no_sample(tmp_path):
    printed = run_cells(GUIDE, tmp_path).splitlines()
    refused = [line for line in printed if line.startswith("refused: ")]
    assert len(refused) == 2
    assert "was taken before" in refused[0]
    assert "at most longest_gap=250 s" in refused[1]
    assert (tmp_path / "tanks.npz").exists()


def test_a_reader_writes_few_lines():
    own = [text for options, text in cells(GUIDE) if "hide-input" not in options]
    assert len(own) > 3
    assert len([line for text in own for line in text.splitlines() if line.strip()]) < 60
