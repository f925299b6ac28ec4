"""A trained policy for a loop of the caller's own: load it from a run, give it observations, take its actions."""

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import gymnasium
import numpy as np

from daedalus.actor.environments.atari import pools_frames
from daedalus.actor.environments.environment_errors import EnvironmentSetupError
from daedalus.actor.environments.gymnasium_backend import as_on_gymnasium
from daedalus.actor.environments.info import MASK_KEY
from daedalus.actor.environments.make import make_bare
from daedalus.actor.environments.transforms import LegalRepeats, Transforms
from daedalus.actor.environments.vector_environments import BackendEnvironments, Observed
from daedalus.actor.evaluation.episodes import RunningEpisodes
from daedalus.policy.acting.noise import Noise, draw_noise, neutral_noise
from daedalus.policy.acting.runtime import OnnxRuntime, PolicyError
from daedalus.policy.component_inputs import coded_components
from daedalus.policy.saving.hub import pull
from daedalus.policy.saving.saved_policy import SavedPolicy, find_policy
from daedalus.policy.saving.saved_policy import pretrained as pretrained_directory
from daedalus.policy.user_modules import NO_MODULES, ModuleNotAllowedError, UserModules
from daedalus.protocol.spaces import ArraySpace, unfit_code
from daedalus.protocol.spec import RunSpec

if TYPE_CHECKING:
    from daedalus.actor.evaluation.exported_policy import ExportOptions
    from daedalus.policy.acting.value_estimator import ValueEstimator


_Kind = TypeVar("_Kind", bound="Policy")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decisions:
    """What a policy chose for N observations, and what its network says of them."""

    actions: Any  # the environment's own, as those of a vector environment: [N] of a Discrete, [N, D] of a Box
    log_probs: np.ndarray  # [N] float32, of the actions, in nats
    values: np.ndarray  # [N] float32, discounted returns in the scale of the rewards that the learner sees
    entropies: np.ndarray  # [N] float32, of the distributions of the actions, in nats
    probabilities: Mapping[str, np.ndarray]  # [N, D, A] by discrete action: of the A choices of its D variables


class Policy:
    """A trained policy that plays one environment: frame stack, memory and action repeat are kept here.

    It takes observations and returns actions of the environment itself; `action_space` and `observation_space` are
    the environment's.
    """

    def __init__(
        self,
        saved: SavedPolicy,
        observation_space: gymnasium.Space,
        action_space: gymnasium.Space,
        modules: UserModules = NO_MODULES,
    ) -> None:
        """Raises EnvironmentSetupError if the spaces are not those that the policy was trained on."""
        self.spec: RunSpec = saved.spec
        self.policy_version: int = saved.policy_version
        self.observation_space, self.action_space = observation_space, action_space
        masks = {name: np.ones((1, size), np.bool_) for name, size in saved.spaces.masks.items()}
        self._transforms = Transforms(saved.spec.environment, observation_space, action_space, masks or None)
        if self._transforms.spaces != saved.spaces:
            raise EnvironmentSetupError(
                f"the environment has {self._transforms.spaces} after the run's transforms; the policy was trained on "
                f"{saved.spaces}: use the environment that the run used (config.toml, versions.json)"
            )
        self._runtime = OnnxRuntime(saved.program)
        self._runtime.load(saved.weights)
        self._saved, self._modules = saved, modules
        self._network: ValueEstimator | None = None  # made when it is needed
        self._random = np.random.default_rng()
        self._repeat = saved.spec.environment.action_repeat
        has_masks = self._repeat > 1 and bool(saved.spaces.masks)
        self._may_repeat = LegalRepeats(saved.spec.environment, observation_space, action_space) if has_masks else None
        self._pools_frames = pools_frames(as_on_gymnasium(saved.spec.environment))
        self.reset()

    def reset(self, *, seed: int | None = None) -> None:
        """Start an episode: forget what was seen. `seed` is for the actions of `act(sampled=True)`."""
        if seed is not None:
            self._random = np.random.default_rng(seed)
        self._running = RunningEpisodes(self._transforms.spaces, self._runtime, 1)
        self._action: Any = None
        self._repeats_left = 0
        self._frame: Any = None  # the previous observation, if frames are pooled

    def act(self, observation: Any, *, sampled: bool = False, action_mask: Any = None) -> Any:
        """Return the action for the next step of the environment: the most probable one, or a sampled one.

        Call it once for every step, with the newest observation, and call `reset` at the start of each episode. If the
        run repeats actions (environment.action_repeat), an action is returned as many times before the next is chosen,
        unless a mask forbids it before.
        An Atari game must not repeat actions itself (frameskip=1): the policy observes the maximum of its two newest
        frames, as in training on the backends `ale` and `envpool`.

        Args:
          observation: one observation, of the environment's own shape and dtype.
          sampled: sample from the policy's distribution, as training does.
          action_mask: the legal choices, if the policy was trained with masks that are not part of the observation: as
            the environment's info["action_mask"] or action_masks() has them.

        Raises ValueError for an observation that is not of the space, and for a mask that is missing or does not fit.
        """
        self._check_mask(action_mask)
        if self._pools_frames:
            observation = self._pooled(observation)
        if self._repeats_left == 0 or not self._goes_on(observation, action_mask):
            self._action = self._choose(observation, action_mask, sampled)
            self._repeats_left = self._repeat
        self._repeats_left -= 1
        return copy.deepcopy(self._action)

    def act_batch(
        self, observations: Sequence[Any] | np.ndarray, *, sampled: bool = False, action_masks: Any = None
    ) -> Decisions:
        """Choose actions for many observations that do not follow each other, with values and probabilities.

        It needs torch, and leaves the episode of `act` as it is. Several threads may call it at once.

        Args:
          observations: N observations of the environment's own space.
          sampled: sample, as for `act`.
          action_masks: N masks, as for `act`.

        Raises ValueError as `act` does, for a policy that remembers earlier observations (a memory, stacked or pooled
        frames), for one of action values or of sac, which lacks probabilities or values, and if the network cannot be
        built, such as for a module of the user that is not allowed.
        """
        spaces, count = self._transforms.spaces, len(observations)
        stacked = any(isinstance(each, ArraySpace) and each.frames > 1 for each in spaces.observations.values())
        if self._runtime.state_size or stacked or self._pools_frames:
            raise ValueError("this policy remembers earlier observations: call act() for one after the other")
        if not count or (action_masks is not None and len(action_masks) != count):
            raise ValueError("give at least one observation, and as many action_masks as observations, or none")
        masks = [None] * count if action_masks is None else action_masks
        for mask in masks:
            self._check_mask(mask)
        rows = [self._observed(*row) for row in zip(observations, masks, strict=True)]
        frames = {name: np.concatenate([row.frames[name] for row in rows]) for name in rows[0].frames}
        legal = {name: np.concatenate([row.masks[name] for row in rows]) for name in rows[0].masks}
        running = RunningEpisodes(spaces, self._runtime, count)
        running.observe(Observed(frames, legal))
        outputs = self._estimator().outputs(running.observations, legal)
        if outputs is None:
            raise ValueError(
                "this policy has no probabilities or no values (it is of action values, or of sac): call act()"
            )
        size = self._runtime.noise_size
        choice = running.act(draw_noise(size, count, self._random) if sampled else neutral_noise(size, count))
        return Decisions(
            actions=self._transforms.env_actions(choice.actions), log_probs=choice.log_probs, **outputs._asdict()
        )

    def export(
        self,
        path: str | Path,
        *,
        sampled: bool = False,
        rows: int | None = None,
        quantize: Literal["float16", "int8"] | None = None,
        licence: str = "",
    ) -> None:
        """Write the policy as one ONNX file that runs with onnxruntime alone; see the guide "Use the policy elsewhere".

        It takes observations and gives actions of the environment itself, greedy ones by default. It needs the package
        `onnx`, and no torch.

        Args:
          path: of the file, which must not exist.
          sampled: sample the actions, from random numbers that become an input of the file.
          rows: observations of each call, as converters for microcontrollers need it; None: any number.
          quantize: convert to smaller numbers. Play with the file before you trust it.
          licence: for the metadata of the file.

        Raises ExportError if that is not possible, such as for a path that exists.
        """
        from daedalus.actor.evaluation.exported_policy import ExportOptions, check_new, write_new

        options = ExportOptions(sampled=sampled, rows=rows, quantize=quantize, licence=licence)
        check_new(Path(path))
        write_new(Path(path), exported_bytes(self, options))

    def _estimator(self) -> "ValueEstimator":
        if self._network is None:
            from daedalus.policy.acting.value_estimator import ValueEstimator  # torch, which `act` does not need

            try:
                self._network = ValueEstimator(self._saved, self._modules)
            except PolicyError as error:
                raise ValueError(str(error)) from None
        return self._network

    def _observed(self, observation: Any, action_mask: Any) -> Observed:
        """Return an observation as the policy reads it. Raises ValueError if it is none of the space, or no code."""
        observed = self._transforms.observe_one(observation, action_mask)
        for name, codes in coded_components(self.spec.policy, self._transforms.spaces.observations).items():
            if unfit := unfit_code(observed.frames[name], codes):
                raise ValueError(f"component {name!r} of the observation {unfit}")
        return observed

    def _pooled(self, frame: Any) -> Any:
        """Return the maximum of the newest two observations, as Atari games were observed in training."""
        before, self._frame = self._frame, np.array(frame)
        return frame if before is None or before.shape != self._frame.shape else np.maximum(before, self._frame)

    def _goes_on(self, observation: Any, action_mask: Any) -> bool:
        """Return whether the last action, which is to be repeated, is still legal."""
        if self._may_repeat is None:
            return True
        return self._may_repeat(self._action, observation, {MASK_KEY: action_mask})

    def _check_mask(self, action_mask: Any) -> None:
        if action_mask is None and self._transforms.needs_mask:
            raise ValueError(
                "this policy was trained with masks of legal actions: call act(observation, action_mask=MASK), with "
                "info['action_mask'] or action_masks() of the environment"
            )
        if action_mask is not None and not self._transforms.spaces.masks:
            raise ValueError(
                "this policy was trained without masks and may choose illegal actions: call act(observation) without "
                "action_mask, or train it on an environment that gives masks"
            )

    def _choose(self, observation: Any, action_mask: Any, sampled: bool) -> Any:
        size = self._runtime.noise_size
        noise = draw_noise(size, 1, self._random) if sampled else neutral_noise(size, 1)
        return self._decide(observation, action_mask, noise)

    def _decide(self, observation: Any, action_mask: Any, noise: Noise) -> Any:
        self._running.observe(self._observed(observation, action_mask))
        return self._transforms.env_action(self._running.act(noise).actions)


def exported_bytes(policy: Policy, options: "ExportOptions") -> bytes:
    """Return the ONNX file of a policy. Raises ExportError."""
    from daedalus.actor.evaluation.exported_policy import exported_file  # `act` does not need it

    caller = {
        "repeat_each_action": policy._repeat,
        "maximum_of_two_frames": policy._pools_frames,
        "left_out": policy.spec.environment.leave_out,
        "wrapper": policy.spec.environment.wrap,
    }
    spaces, size = (policy.observation_space, policy.action_space), policy._runtime.noise_size
    return exported_file(policy._saved, policy._transforms, spaces, size, options, caller)


def another_player(policy: Policy, kind: type[_Kind]) -> _Kind:
    """Return another player of the same policy, of a class that derives from Policy, at the start of an episode.

    It is for the run's own environment, which takes the maximum of two frames itself where `act` would.
    """
    player = kind(policy._saved, policy.observation_space, policy.action_space, policy._modules)
    player._pools_frames = False
    return player


def environments_of(policy: Policy) -> BackendEnvironments:
    """Return the run's environment, of which the caller, as that of `act`, repeats the actions.

    Raises EnvironmentSetupError.
    """
    return _make(policy.spec, policy._modules, action_repeat=1)


def load_policy(
    directory: str | Path | None = None,
    *,
    newest: bool = False,
    pretrained: str | None = None,
    from_hub: str | None = None,
    revision: str | None = None,
    allow_modules: Collection[str] = (),
    observation_space: gymnasium.Space | None = None,
    action_space: gymnasium.Space | None = None,
) -> Policy:
    """Load the policy of a run, one that ships with the package, or one on the Hub.

    Args:
      directory: a run directory, or one of its checkpoints; of a run the best checkpoint by its evaluations, else by
        its training episodes, else the newest.
      newest: load the newest checkpoint of the run, not the best.
      pretrained: the name of a policy that ships with the package, in place of a directory.
      from_hub: USER/NAME of a policy on the Hugging Face Hub that `daedalus push` uploaded, in place of a directory.
      revision: branch, tag or commit on the Hub (default: the newest of main).
      allow_modules: modules that may be imported to make the run's environment: those of an environment `module:Id` and
        of a wrapper `module:function`. Importing a module runs it, and a file named it.
      observation_space, action_space: of the environment to play, if it was changed by wrappers or cannot be made here;
        by default the run's environment is made once to learn its spaces.

    Raises NoPolicyError if there is no checkpoint or no such pretrained policy, DamagedError if none can be read,
    HubError if a policy cannot be pulled, EnvironmentSetupError if the environment cannot be made, needs a module that
    is not allowed or is not the one of the run, and ValueError if not exactly one of directory, pretrained and from_hub
    is given, or only one of the spaces.
    """
    if sum(source is not None for source in (directory, pretrained, from_hub)) != 1:
        raise ValueError("name either a run directory or a pretrained policy or one on the Hub (from_hub)")
    if revision is not None and from_hub is None:
        raise ValueError("revision is that of a policy on the Hub: give from_hub too")
    if (observation_space is None) != (action_space is None):
        raise ValueError("give both observation_space and action_space, or neither")
    if from_hub is not None:
        path = pull(from_hub, revision)
    else:
        path = Path(directory) if directory is not None else pretrained_directory(pretrained or "")
    saved = find_policy(path, newest)
    modules = UserModules(frozenset(allow_modules), f"the run of {from_hub or saved.directory}")
    if observation_space is None or action_space is None:
        try:
            modules.check(saved.spec.environment.user_modules)
        except ModuleNotAllowedError as error:
            raise EnvironmentSetupError(error.in_python) from error
        environment = _make(saved.spec, modules)
        environment.close()
        observation_space, action_space = environment.observation_space, environment.action_space
    return Policy(saved, observation_space, action_space, modules)


def _make(spec: RunSpec, modules: UserModules, **changes: Any) -> BackendEnvironments:
    """Return the environment of a run in this process, on gymnasium's implementation unless it is a game."""
    environment = as_on_gymnasium(spec.environment).model_copy(update={"processes": False, **changes})
    return make_bare(environment, 1, modules)[0]
