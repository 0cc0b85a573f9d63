"""Pictures of a record: `robot` is one robot's mission; `style` is what all pictures share."""
