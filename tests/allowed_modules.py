"""The modules of the tests that environments may import."""

from daedalus.policy.user_modules import UserModules

TEST_MODULES = UserModules(
    frozenset({"counting_environment", "picture_environment", "corridor", "corridor_wrappers", "test_car_racing"})
)
