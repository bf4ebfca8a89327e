"""Systems of several bodies with entropies of their own, coupled by forces and by the flow of heat."""
