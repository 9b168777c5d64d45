"""Tours of the airway to several nodules in one procedure [Pan2025]."""
