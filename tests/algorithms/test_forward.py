"""algorithms/forward.py: the target network moves towards the network that is being learned."""

import pytest
import torch
from building import POLICY, SPACES

from daedalus.algorithms.forward import FlatParameters, Forward
from daedalus.policy.network.actor_critic import ActorCritic


@pytest.mark.parametrize(("share", "expected"), [(1.0, 4.0), (0.25, 1.0)])
def test_target_network_moves_by_a_share_of_the_way(share: float, expected: float) -> None:
    network = ActorCritic(POLICY, SPACES)
    learned = FlatParameters(network.learned_parameters())
    forward = Forward(network, learned, has_target=True, is_mixed=False)
    before = forward.target_values.clone()
    learned.values.add_(4.0)
    forward.update_target(share)
    torch.testing.assert_close(forward.target_values, before + expected)
    torch.testing.assert_close(
        torch.cat([each.flatten() for each in forward.target_parameters.values()]), before + expected
    )
    torch.testing.assert_close(learned.values, before + 4.0)
