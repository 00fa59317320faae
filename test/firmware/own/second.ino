void copy_pins() {
  digitalWrite(5, digitalRead(4));
  analogWrite(9, digitalRead(6) ? 100 : 0);
}
bool every(unsigned long ms) {
  static unsigned long last = 0;
  if (millis() - last < ms) return false;
  last = millis();
  return true;
}
