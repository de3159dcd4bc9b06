"""What every plant, observer and learner must do, found by itself: a new one is tested by existing."""
