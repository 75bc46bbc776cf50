"""How much memory a call takes at its peak."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scripts.benchmark import peak


@pytest.mark.skipif(not Path("/proc/self/clear_refs").is_file(), reason="peaks are told by Linux alone")
def test_what_a_call_claims_and_frees_is_measured_whatever_was_claimed_before() -> None:
    np.ones(200 << 17)  # 200 MiB, freed again
    assert 45 < peak.peak_growth(lambda: np.ones(50 << 17)) < 60
    assert peak.peak_growth(lambda: None) < 5


def test_elsewhere_it_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peak, "PROC", tmp_path / "none")
    with pytest.raises(SystemExit, match="on Linux alone"):
        peak.peak_growth(lambda: None)
