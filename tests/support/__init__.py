"""What tests share: servers, photos, and a client that looks at everything."""
