"""Random bodies: no shape in two groups, inside the walls, the same body when it is filled again, and frame rates within their range."""

import numpy as np
import pytest

from neuido.errors import UserError
from neuido.models.video.clip_bodies import GROUPS, PUBLISHED, SOLIDS, frame_steps, launch, random_body, random_shape


def test_no_shape_is_in_two_groups():
    names = [name for group in GROUPS for name in (*SOLIDS[group], *PUBLISHED[group])]
    assert len(names) == len(set(names)) and len([name for own in PUBLISHED.values() for name in own]) == 10


@pytest.mark.parametrize("group", GROUPS)
def test_bodies_fit_between_the_walls_and_can_be_filled_again(group):
    seen = set()
    for number in range(12):
        name, x, volume = random_body(np.random.default_rng(number), 300, group, False)
        assert name == random_shape(np.random.default_rng(number), group, False)
        again, other, same = random_body(np.random.default_rng(number), 300, group, False, fill=1)
        seen.add(name)
        assert again == name and volume == pytest.approx(same, rel=0.12) and not np.array_equal(x, other)
        assert np.abs(np.ptp(x, axis=0) - np.ptp(other, axis=0)).max() < 0.08
        lift, velocity, _ = launch(np.random.default_rng(number), x, 0.4)
        assert (x + lift).min() > 0 and (x + lift).max() < 1 and velocity[1] <= 0
    assert seen <= set(SOLIDS[group]) and len(seen) > 1


def test_frame_rates_are_within_their_range_and_steps_within_their_limit():
    drawn = [frame_steps((24.0, 400.0), 1e-3, np.random.default_rng(number)) for number in range(200)]
    rates = np.array([1 / (dt * steps) for dt, steps in drawn])
    assert 24 <= rates.min() < 40 and 250 < rates.max() <= 400
    assert max(dt for dt, _ in drawn) <= 1e-3 and len({steps for _, steps in drawn}) < 10


def test_an_unknown_group_is_named():
    with pytest.raises(UserError, match="shapes = 'new'"):
        random_body(np.random.default_rng(0), 300, "new", False)
