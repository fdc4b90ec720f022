"""The floor under `photogram` and `shaker`: definitions that both need, without a dependency on either."""
