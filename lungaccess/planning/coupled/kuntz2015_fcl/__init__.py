"""Reference mode: Algorithm 1 of [Kuntz2015] as printed, a slow yardstick that knows no clearance fields."""
