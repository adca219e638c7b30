"""The ALOHA scene of gym-aloha: two ViperX 300 S arms, a table, a red cube."""
