"""Links to peers (tcp, udp, serial), and conversations: one session over one link. Knows no protocol and no bus."""
