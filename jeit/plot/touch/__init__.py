"""Pictures of what learnt skins say, and of how well they learnt."""
