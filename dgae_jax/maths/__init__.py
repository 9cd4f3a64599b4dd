"""The paper's mathematics as pure functions of arrays: distributions, estimators, the normal distribution, statistics, preferences."""
