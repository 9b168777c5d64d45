"""What a needle does to tubes that stand when it comes, free and in tissue."""
