"""Leagues for tests of what people see."""

from daedalus.protocol.league import LeagueStatus, RatedPlayer, Score

# Rock, paper and scissors: each version beats the one before, and the first beats the last.
LEAGUE = LeagueStatus(
    players=(
        RatedPlayer(player="newest", rating=1312.5, deviation=50.0, matches=1200),
        RatedPlayer(player="v0", rating=200.0, deviation=20.0, matches=90),
        RatedPlayer(player="v100", rating=280.0, deviation=15.0, matches=80),
        RatedPlayer(player="v200", rating=300.0, deviation=10.0, matches=70),
        RatedPlayer(player="my_bots:Greedy", rating=250.0, deviation=10.0, matches=60),
        RatedPlayer(player="random", rating=0.0, deviation=0.0, matches=50),
    ),
    scores=(
        Score(first="newest", second="random", wins=48, draws=1, losses=1),
        Score(first="my_bots:Greedy", second="newest", wins=10, draws=10, losses=40),
        Score(first="v0", second="newest", wins=30, losses=10),
        Score(first="newest", second="v200", wins=9.5, losses=0.5),
        Score(first="v0", second="v100", losses=40),
    ),
)
