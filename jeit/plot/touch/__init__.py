"""Pictures of contacts in images, and of what learnt skins say and how well they learnt."""
