static void after_prediction(const struct plan *plan, real *P) { (void)plan, (void)P; }
