"""What a system reaches of a lung, and proofs of what it does not."""
