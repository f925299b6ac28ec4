"""The network and its forward pass, both ways: torch for learning, a program with numpy around it for acting."""
