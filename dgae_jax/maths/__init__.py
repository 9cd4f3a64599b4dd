"""The paper's mathematics as pure functions of arrays; statistics and risk measures."""
