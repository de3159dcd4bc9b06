"""The rules that every plant, observer and learner must keep; new ones are found and tested."""
