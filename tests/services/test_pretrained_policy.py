"""The pre-trained policy in the default simulator."""

from __future__ import annotations

from proto.config import Config
from services.playing.workers import play_all
from services.trials.evaluation import trial_jobs


def test_it_lifts_the_object_in_unlearned_situations() -> None:
    config = Config()
    jobs = trial_jobs(config, trials=5, seed=8000)
    played = list(play_all(config, "pretrained:experiment1", jobs, workers=1))
    # another graphics driver may draw a pixel otherwise
    assert sum(episode.outcome.strict for _, episode in played) >= 4
