"""The searches for plans: over the deployment atlas, and Algorithm 1 of [Kuntz2015]."""
