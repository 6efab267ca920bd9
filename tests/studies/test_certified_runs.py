"""The case of certified runs, in small."""

import pytest

from ctmhe.studies.reproduce import certified_runs as case


@pytest.mark.slow
def test_bounds_are_never_crossed_and_controls_cross_them():
    """On the discrete circuit: ratios below one for every trigger, level and adversary; controls above one."""
    found = case.one_plant(case.PLANTS[1], 1, trials=2, progress=False)
    assert found["runs"] == 15
    for numbers in (*found["largest_ratios"].values(), *found["adversarial"].values()):
        assert max(numbers[name] for name in (*case.RATIOS, "online_ratio")) <= 1 and numbers["uncertified"] == 0
    for level in ("|w| <= 1e-3", "w = 0"):
        for control in found["negative_controls"][level].values():
            assert all(control[name] > 1 for name in case.RATIOS)
    assert found["forced_wait"]["certified"] == [True, True, False, True, True]
    assert "waited" in found["forced_wait"]["reason"]
    lossy = found["lossy_channel"]
    assert 0 < lossy["certified"] < lossy["solves"] and "lost" in lossy["reason"]
