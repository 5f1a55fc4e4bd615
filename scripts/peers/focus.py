def peers_autofocus(*a): raise NotImplementedError
