"""The stability suite: the cases of every folder, run by one command; cases of messages, models and prediction."""
