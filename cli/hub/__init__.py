"""Policies on the Hugging Face Hub: the model card, and the upload. policy/saving/hub.py pulls them."""
