from .catalogue import Recipe, Repository, find_recipe, list_recipes
from .make import Verdict, check_recipe, get_trace

__all__ = [
    "Recipe",
    "Repository",
    "Verdict",
    "check_recipe",
    "find_recipe",
    "get_trace",
    "list_recipes",
]
