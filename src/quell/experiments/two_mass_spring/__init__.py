"""The paper's simulation study on two masses and a spring, every claim judged."""
