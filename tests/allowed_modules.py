"""The modules of the tests that environments may import."""

from daedalus.policy.user_modules import UserModules

TEST_MODULES = UserModules(
    frozenset(
        {
            "absent_environment",
            "corridor",
            "corridor_wrappers",
            "counting_environment",
            "faulty_environments",
            "lesson_environment",
            "mission_environment",
            "nested_environment",
            "picture_environment",
            "scripted_games",
            "test_car_racing",
        }
    )
)
