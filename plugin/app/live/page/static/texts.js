// All words of the page. The English ones are the keys; `#` stands for a number. What the program says
// (coach, metrics, exercises) is looked up here too, and stays English where it is not found.
const GERMAN = {
  // Places of the page.
  "Home": "Start", "Exercises": "Übungen", "Tutorial": "Einführung", "Free practice": "Freies Üben", "your name": "dein Name",
  "assessment": "Prüfung", "exercise": "Übung", "organ": "Organ", "mesh": "Netz", "scheme": "Verfahren", "instrument": "Instrument",
  "More": "Mehr", "device of the hand": "Gerät der Hand", "device of the other hand": "Gerät der anderen Hand", "speed": "Tempo",
  "scale of movements": "Maßstab der Bewegungen", "seed": "Startzahl", "time step": "Zeitschritt", "sound": "Ton", "computed on": "rechnet auf",
  "language": "Sprache", "Start": "Start", "Pause": "Pause", "Resume": "Weiter", "Stop": "Ende", "Free view": "Freie Sicht", "Wireframe": "Netz",
  "Show me": "Zeig es mir", "Draw a line": "Linie zeichnen", "The line: {0} % followed, {1} mm off on average": "Die Linie: {0} % verfolgt, im Mittel {1} mm daneben", "Camera": "Kamera", "Follow": "Folgen", "device of the laparoscope": "Gerät des Laparoskops",
  "keys and buttons of this page": "Tasten und Knöpfe dieser Seite", "turn the camera left": "Kamera links drehen", "turn the camera right": "Kamera rechts drehen",
  "Deeper": "Tiefer", "Back": "Zurück", "Grip": "Greifen", "Here": "Hier", "Clutch": "Kuppeln", "roll left": "links drehen",
  "roll right": "rechts drehen", "Force": "Kraft", "Force [N]": "Kraft [N]", "Progress": "Fortschritt", "Time": "Zeit",
  "Displacement of the organ at the tip [mm]": "Verschiebung des Organs an der Spitze [mm]", "Speed of the simulation": "Tempo der Simulation",
  "Steps a second": "Schritte je Sekunde", "How to move": "So wird bewegt", "what the laparoscope sees": "was das Laparoskop sieht",
  "Mouse and touch: drag to move the tip across the picture. Use the wheel or two fingers for depth. Press Shift and drag to roll.":
    "Maus und Finger: ziehen bewegt die Spitze im Bild. Rad oder zwei Finger für die Tiefe. Mit Umschalt ziehen dreht.",
  "Keys: arrows or W A S D move across the picture, Q away and E towards you, Z and X roll. G closes the jaws, R reports, C is the clutch, P pauses, H shows the expert.":
    "Tasten: Pfeile oder W A S D bewegen im Bild, Q weg und E heran, Z und X drehen. G schließt die Backen, R meldet, C kuppelt, P hält an, H zeigt die Könnerin.",
  "Gamepad: the left stick moves across the picture, the right stick sets depth and roll. The first button grips, the second reports, the third is the clutch.":
    "Gamepad: der linke Stick bewegt im Bild, der rechte stellt Tiefe und Drehung. Der erste Knopf greift, der zweite meldet, der dritte kuppelt.",
  "Needle drivers have a wrist: with Shift, the arrows or a drag up and down tilt the jaws, and the arrows or the wheel turn them sideways. On a gamepad the cross does both. Z and X roll them.":
    "Nadelhalter haben ein Handgelenk: mit Umschalt neigen die Pfeiltasten oder Ziehen auf und ab die Backen, und die Pfeiltasten oder das Rad drehen sie zur Seite. Am Gamepad tut beides das Kreuz. Z und X rollen sie.",
  "tilt the jaws up": "Backen nach oben neigen", "tilt the jaws down": "Backen nach unten neigen", "turn the jaws left": "Backen nach links drehen", "turn the jaws right": "Backen nach rechts drehen",
  "Laparoscope: I J K L move it across the picture, U in and O out, N and M roll the scope, V and B turn the camera. F lets it follow the tip. With Y, or Camera, everything above moves the laparoscope.":
    "Laparoskop: I J K L bewegen es im Bild, U hinein und O heraus, N und M drehen die Optik, V und B die Kamera. Mit F folgt es der Spitze. Mit Y, oder Kamera, bewegt alles Obige das Laparoskop.",
  "Free view: drag to rotate the picture. Two fingers, or Shift and drag, pan it. The wheel or a pinch zooms. Keys and gamepad still move the instrument.":
    "Freie Sicht: ziehen dreht das Bild. Zwei Finger, oder Umschalt und ziehen, schieben es. Rad oder Spreizen vergrößert. Tasten und Gamepad bewegen weiter das Instrument.",
  "own scene": "eigene Szene", "liver": "Leber", "liver inclusion": "Leber mit Einschluss", "gallbladder": "Gallenblase", "stomach": "Magen", "kidney": "Niere",
  "probe": "Taststab", "grasper": "Greifer", "scissors": "Schere", "hook": "Haken", "scalpel": "Skalpell",
  // Home.
  "Begin with the tutorial": "Beginne mit der Einführung", "It teaches how your hand moves the instrument, without clock and limits.":
    "Sie zeigt, wie deine Hand das Instrument bewegt, ohne Uhr und Grenzen.",
  "next": "als Nächstes", "done": "geschafft", "proficient": "sicher", "open": "offen", "after {0}": "nach {0}", "{0} of {1} attempts proficient": "{0} von {1} Versuchen sicher",
  // Domains, and the words that levels are made of.
  "touch/": "Berühren", "probe/": "Drücken und Tasten", "trace/": "Nachfahren", "grasp/": "Greifen", "retract/": "Weghalten", "tease/": "Ablösen",
  "dissect/": "Abpräparieren", "cut/": "Schneiden", "bimanual/": "Mit zwei Händen", "navigate/": "Kamera führen", "needle/": "Nadel übergeben", "suture/": "Nähen",
  "easy": "leicht", "standard": "mittel", "hard": "schwer", "depth": "Tiefe", "palpate": "tasten", "drive": "durchstechen", "running": "fortlaufend", "stitch": "Stich", "transfer": "übergeben", "extracorporeal": "Knoten hinunterschieben", "knot": "knoten",
  // What exercises ask for.
  "touch one point within # mm": "berühre einen Punkt auf # mm genau", "touch four points within # mm": "berühre vier Punkte auf # mm genau",
  "touch six points within # mm, on livers that vary": "berühre sechs Punkte auf # mm genau, auf wechselnden Lebern",
  "show two marks with optics of # degrees, centred and level": "zeige zwei Marken mit einer Optik von # Grad, mittig und gerade",
  "show three marks along their pins with optics of # degrees, centred and level": "zeige drei Marken ihre Stifte entlang mit einer Optik von # Grad, mittig und gerade",
  "show three marks along their pins, then follow an instrument for # s, on varying livers": "zeige drei Marken ihre Stifte entlang, dann folge einem Instrument # s lang, auf wechselnden Lebern",
  "press one site with # to # N for # s": "drücke eine Stelle mit # bis # N, # s lang",
  "press three sites with # to # N for # s each": "drücke drei Stellen mit # bis # N, je # s lang",
  "press four sites with # to # N for # s each, on livers that vary": "drücke vier Stellen mit # bis # N, je # s lang, auf wechselnden Lebern",
  "press three sites # to # mm deep for # s each": "drücke drei Stellen # bis # mm tief, je # s lang",
  "find an inclusion ten times as stiff, within # mm": "finde einen zehnmal so harten Einschluss, auf # mm genau",
  "find an inclusion eight times as stiff, within # mm": "finde einen achtmal so harten Einschluss, auf # mm genau",
  "find an inclusion five times as stiff, within # mm, on varying kidneys": "finde einen fünfmal so harten Einschluss, auf # mm genau, auf wechselnden Nieren",
  "trace an arc of about # mm within # mm": "fahre einen Bogen von etwa # mm nach, auf # mm genau",
  "trace an S of about # mm within # mm": "fahre ein S von etwa # mm nach, auf # mm genau",
  "trace a double S of about # mm within # mm, on stomachs that vary": "fahre ein doppeltes S von etwa # mm nach, auf # mm genau, auf wechselnden Mägen",
  "lift the fundus by # mm for # s": "hebe den Fundus um # mm, # s lang",
  "lift the fundus by # mm for # s with less force, on varying organs": "hebe den Fundus um # mm, # s lang, mit weniger Kraft, an wechselnden Organen",
  "uncover half of a disc of # mm for # s": "decke die Hälfte einer Scheibe von # mm auf, # s lang",
  "uncover # % of a disc of # mm for # s": "decke # % einer Scheibe von # mm auf, # s lang",
  "uncover a disc of # mm for # s with less force, on varying organs": "decke eine Scheibe von # mm auf, # s lang, mit weniger Kraft, an wechselnden Organen",
  "free # % of a filmy adhesion": "löse # % einer zarten Verwachsung", "free half of it": "löse die Hälfte davon",
  "free # % of a dense one with less force": "löse # % einer festen mit weniger Kraft",
  "free half of the gallbladder's bed": "löse die Hälfte des Gallenblasenbetts", "free # % of it": "löse # % davon",
  "free # % of a tough bed with less force, on varying organs": "löse # % eines zähen Betts mit weniger Kraft, an wechselnden Organen",
  "cut out a circle of # mm within # mm of its line": "schneide einen Kreis von # mm aus, auf # mm an seiner Linie",
  "cut out a circle of # mm within # mm, as FLS asks for": "schneide einen Kreis von # mm aus, auf # mm genau, wie FLS es verlangt",
  "cut out a clover of # mm within # mm": "schneide ein Kleeblatt von # mm aus, auf # mm genau",
  "hold the gallbladder and divide half of its bed with a hook": "halte die Gallenblase und trenne die Hälfte ihres Betts mit einem Haken",
  "divide # % of it": "trenne # % davon",
  "divide # % of it with less force, on varying organs": "trenne # % davon mit weniger Kraft, an wechselnden Organen",
  "pass a needle through a ring of # mm into the other hand": "gib eine Nadel durch einen Ring von # mm in die andere Hand",
  "pass a needle through two rings of # mm, there and back": "gib eine Nadel durch zwei Ringe von # mm, hin und zurück",
  "pass a needle through three rings of # mm, from hand to hand": "gib eine Nadel durch drei Ringe von # mm, von Hand zu Hand",
  "drive a needle through two marks # mm apart, within # mm": "stich eine Nadel durch zwei Marken in # mm Abstand, auf # mm genau",
  "place the last of four stitches within # mm of its marks, and close the cut": "setze den letzten von vier Stichen auf # mm genau an seine Marken, und schließe den Schnitt",
  "place two of four stitches within # mm of their marks, and close the cut": "setze zwei von vier Stichen auf # mm genau an ihre Marken, und schließe den Schnitt",
  "place three of them within # mm, in the wall of a stomach that is stretched more": "setze drei davon auf # mm genau, in der stärker gespannten Wand eines Magens",
  "drive it within # mm, in changing directions": "stich sie auf # mm genau, in wechselnden Richtungen",
  "drive it within # mm, as FLS asks for, through a tougher wall": "stich sie auf # mm genau, wie FLS es verlangt, durch eine zähere Wand",
  "push one throw down, and close the slit to # mm": "schiebe einen Wurf hinunter und schließe den Schlitz auf # mm",
  "tie one throw with two needle drivers, and close the slit to # mm": "knüpfe einen Wurf mit zwei Nadelhaltern und schließe den Schlitz auf # mm",
  "tie a double throw, the first one of a surgeon's knot": "knüpfe einen doppelten Wurf, den ersten eines chirurgischen Knotens",
  "drive a needle through both lips of a slit within # mm of its marks, and tie one throw":
    "stich eine Nadel durch beide Lippen eines Schlitzes, auf # mm genau an seine Marken, und knüpfe einen Wurf",
  "drive it within # mm, as FLS asks for, and tie a double throw": "stich sie auf # mm genau, wie FLS es verlangt, und knüpfe einen doppelten Wurf",
  "push down two throws, a square knot that holds # N": "schiebe zwei Würfe hinunter, einen Kreuzknoten, der # N hält",
  "push down three throws, the first double, a surgeon's knot that holds # N": "schiebe drei Würfe hinunter, den ersten doppelt, einen chirurgischen Knoten, der # N hält",
  // What runs.
  "Loading {0}": "Lädt {0}", "Loading {0}, which takes a minute or more": "Lädt {0}, das dauert eine Minute oder mehr",
  "{0}: {1} s. The first time, kernels are compiled, for up to a minute": "{0}: {1} s. Beim ersten Mal werden Rechenkerne übersetzt, bis zu einer Minute lang",
  "Choose an exercise and press Start.": "Wähle eine Übung und drücke Start.",
  "Choose an organ and press Start. Every choice may be changed while it runs.": "Wähle ein Organ und drücke Start. Alles lässt sich ändern, während es läuft.",
  "No connection to the program. Recordings are kept. Connecting again": "Keine Verbindung zum Programm. Aufnahmen sind gesichert. Verbindet neu",
  "Connecting to the program": "Verbindet mit dem Programm", "The address asks for {0}: there is no such exercise": "Die Adresse verlangt {0}: diese Übung gibt es nicht",
  "All places are taken; close another page": "Alle Plätze sind besetzt; schließe eine andere Seite", "No picture from the program for {0} s": "Seit {0} s kein Bild vom Programm",
  "The graphics card has dropped the picture": "Die Grafikkarte hat das Bild verloren",
  "Assessment: no help": "Prüfung: keine Hilfe", "The clock starts with your first movement": "Die Uhr beginnt mit deiner ersten Bewegung",
  "The clock is stopped; it goes on when you move": "Die Uhr steht; sie läuft weiter, wenn du dich bewegst",
  "Computing the expert's path. The clock is stopped": "Der Weg der Könnerin wird berechnet. Die Uhr steht",
  "waiting": "wartet", "clutch": "gekuppelt", "lost": "Gerät fehlt", "paused": "angehalten", "{0} N, limit {1} N": "{0} N, Grenze {1} N", "{0} of {1} s": "{0} von {1} s",
  "real time": "Echtzeit", "{0} × real time": "{0} × Echtzeit", "default": "voreingestellt", "# nodes": "# Knoten", "none": "keines",
  "mouse, touch, keys, gamepad": "Maus, Finger, Tasten, Gamepad", "keyboard, on this page": "Tasten dieser Seite", "gamepad, on this page": "Gamepad dieser Seite",
  "{0} steps a second": "{0} Schritte je Sekunde", "{0} % on time": "{0} % pünktlich", "{0} of real time": "{0} der Echtzeit",
  "{0} pictures a second": "{0} Bilder je Sekunde", "hand to picture {0} ms": "Hand bis Bild {0} ms",
  "This browser draws no WebGL 2": "Dieser Browser zeichnet kein WebGL 2",
  "Switch on its hardware acceleration, or try another browser. The exercise as a film, from the command line:":
    "Schalte die Hardwarebeschleunigung ein oder nimm einen anderen Browser. Die Übung als Film, von der Befehlszeile:",
  // Tutorial.
  "Move the tip to the right": "Bewege die Spitze nach rechts", "Move it back to the left": "Bewege sie zurück nach links", "Move it up": "Bewege sie nach oben",
  "Move it down": "Bewege sie nach unten", "Go deeper, away from you": "Geh tiefer, von dir weg", "Come back towards you": "Komm zurück, auf dich zu",
  "Roll the instrument": "Drehe das Instrument", "Touch the organ gently and watch the force": "Berühre das Organ sanft und sieh auf die Kraft", "Let go of it": "Löse dich von ihm",
  "Well done. Needle drivers turn their wrist too, with Shift. Go on as you like, or press Stop and begin with the first exercise": "Gut gemacht. Nadelhalter drehen mit Umschalt auch ihr Handgelenk. Mach weiter, wie du magst, oder drücke Ende und beginne die erste Übung",
  "drag, or the arrow keys": "ziehen, oder die Pfeiltasten", "the wheel, two fingers, or Q": "Rad, zwei Finger oder Q", "the wheel, two fingers, or E": "Rad, zwei Finger oder E",
  "Shift and drag, or Z and X": "Umschalt und ziehen, oder Z und X", "Step {0} of {1}": "Schritt {0} von {1}",
  // The card.
  "Done": "Geschafft", "Done, and proficient": "Geschafft, und sicher", "Not done": "Nicht geschafft", "What was good": "Was gut war", "What to do next": "Was als Nächstes zu tun ist",
  "Try again": "Noch einmal", "Next: {0}": "Weiter: {0}", "Close": "Schließen", "Save again": "Noch einmal sichern", "Details": "Einzelheiten", "metric": "Größe", "yours": "du", "limit": "Grenze",
  "unit": "Einheit", "count": "Anzahl", "Score {0}": "Wertung {0}", "Better than most skilled people: {0}": "Besser als die meisten Könner: {0}", "You reached the end": "Du hast das Ende erreicht",
  "You kept within {0} of {1} limits": "Du hast {0} von {1} Grenzen eingehalten", "Nothing was measured: there was no movement": "Nichts wurde gemessen: es gab keine Bewegung",
  "{0}: {1}, skilled people have at most {2}": "{0}: {1}, Könner haben höchstens {2}", "{0}: {1}, skilled people have at least {2}": "{0}: {1}, Könner haben mindestens {2}",
  "Everything is within its limits: do it again until it is a habit": "Alles ist in seinen Grenzen: mach es noch einmal, bis es sitzt", "Try it again, slowly; Show me shows how": "Versuche es noch einmal, langsam; Zeig es mir zeigt, wie",
  "Recording: {0}": "Aufnahme: {0}", "The recording is not in a file yet; it is kept while this page is open.": "Die Aufnahme ist noch in keiner Datei; sie bleibt, solange diese Seite offen ist.",
  // What the program says.
  "Success, after # s": "Geschafft, nach # s", "Failed: the time ran out, after # s": "Nicht geschafft: die Zeit war um, nach # s",
  "Failed: the needle was dropped, after # s": "Nicht geschafft: die Nadel fiel hinunter, nach # s",
  "Failed: a hole is too far from its mark, after # s": "Nicht geschafft: ein Stich ist zu weit von seiner Marke, nach # s",
  "Failed: a stitch came out, after # s": "Nicht geschafft: ein Stich ging auf, nach # s",
  "Failed: thread broken, after # s": "Nicht geschafft: der Faden ist gerissen, nach # s", "Failed: torn out of the drain, after # s": "Nicht geschafft: aus dem Drain gerissen, nach # s",
  "Failed: the knot did not hold, after # s": "Nicht geschafft: der Knoten hielt nicht, nach # s", "Failed: a wrong knot, after # s": "Nicht geschafft: ein falscher Knoten, nach # s",
  "Failed: reported a wrong place, after # s": "Nicht geschafft: falsche Stelle gemeldet, nach # s", "Stopped before the end, after # s": "Vor dem Ende beendet, nach # s",
  "Failed: tissue was harmed, after # s": "Nicht geschafft: Gewebe wurde verletzt, nach # s", "Failed: too much force: # N, after # s": "Nicht geschafft: zu viel Kraft: # N, nach # s",
  "Failed: too much force by the shaft: # N, after # s": "Nicht geschafft: zu viel Kraft des Schafts: # N, nach # s",
  "Failed: too much force on the surroundings: # N, after # s": "Nicht geschafft: zu viel Kraft auf die Umgebung: # N, nach # s",
  "Failed: torn by a pull of # N, after # s": "Nicht geschafft: bei einem Zug von # N gerissen, nach # s", "Failed: torn off: # %, after # s": "Nicht geschafft: # % abgerissen, nach # s",
  "Failed: # mm are cut beside the line, slashed or dragged, after # s": "Nicht geschafft: # mm neben der Linie, hastig oder unter Zug geschnitten, nach # s",
  "Failed: burnt for # s, after # s": "Nicht geschafft: # s lang verbrannt, nach # s", "Failed: the hook's force, after # s": "Nicht geschafft: zu viel Kraft des Hakens, nach # s",
  "Touch the yellow point gently, # of #": "Berühre den gelben Punkt sanft, # von #", "Let go of the organ": "Löse dich vom Organ", "Go to the yellow site, # of #": "Geh zur gelben Stelle, # von #",
  "Press more": "Drücke mehr", "Press less": "Drücke weniger", "Hold it there for # s more": "Halte so noch # s", "Touch the beginning of the line": "Berühre den Anfang der Linie",
  "Touch the line where you have left it, and go on": "Berühre die Linie, wo du sie verlassen hast, und mach weiter", "Follow the line in light contact, # % done": "Folge der Linie mit leichtem Kontakt, # % geschafft",
  "Open the jaws, go over the marked fold and close them gently": "Öffne die Backen, geh über die markierte Falte und schließe sie sanft", "Open the jaws to let go": "Öffne die Backen, um loszulassen",
  "Lower it to where it was": "Senke es, wohin es gehört", "Lift it by # mm, towards the trocar": "Hebe es um # mm, zum Trokar hin", "Pull it aside: # of # % are seen": "Zieh es zur Seite: # von # % sind zu sehen",
  "Pull less: the liver gives": "Zieh weniger: die Leber gibt nach", "Pull it further from its bed": "Zieh es weiter von seinem Bett", "Current off": "Strom aus",
  "Hold it so, and divide its bed with the hook: # of # % are free": "Halte es so, und trenne sein Bett mit dem Haken: # von # % sind frei",
  "Pull it off its bed: # of # % are free": "Zieh es von seinem Bett: # von # % sind frei", "Go under the flap and push gently along, side by side: # of # % are free": "Geh unter den Lappen und schiebe sanft, Seite an Seite: # von # % sind frei",
  "Push the tip of the blade through the line": "Stich die Klinge durch die Linie", "Cut along the line: # % done": "Schneide an der Linie entlang: # % geschafft",
  "Press here and there, and report where it is stiff while you press: # % of the field is felt": "Drücke hier und dort, und melde beim Drücken, wo es hart ist: # % des Felds sind getastet",
  "Find the yellow mark, # of #": "Finde die gelbe Marke, # von #", "Find the instrument, # of #": "Finde das Instrument, # von #",
  "Bring the yellow mark into the middle, # of #": "Bring die gelbe Marke in die Mitte, # von #", "Bring the instrument into the middle, # of #": "Bring das Instrument in die Mitte, # von #",
  "Go nearer": "Geh näher heran", "Go back": "Geh zurück", "Roll the scope until you look along the pin": "Drehe die Optik, bis du den Stift entlang siehst",
  "Turn the camera until the picture is level": "Drehe die Kamera, bis das Bild gerade steht",
  "Take the needle": "Nimm die Nadel", "Bring the needle's tip through ring # of #": "Führe die Spitze der Nadel durch Ring # von #",
  "Bring the needle's blunt end through ring # of #": "Führe das stumpfe Ende der Nadel durch Ring # von #", "Pull it through": "Zieh sie hindurch",
  "Take the needle with the left hand": "Nimm die Nadel mit der linken Hand", "Take the needle with the right hand": "Nimm die Nadel mit der rechten Hand",
  "Let go with the left hand": "Lass mit der linken Hand los", "Let go with the right hand": "Lass mit der rechten Hand los",
  "Bring the needle's tip to the yellow mark, and turn it in": "Führe die Spitze der Nadel zur gelben Marke, und drehe sie hinein",
  "Bring the needle's tip to the yellow mark of stitch # of #, and turn it in": "Führe die Nadelspitze zur gelben Marke von Stich # von # und drehe sie hinein",
  "Take the needle's tip with the left hand, and draw it through": "Nimm die Nadelspitze mit der linken Hand und ziehe sie durch",
  "Pull the thread until the cut is closed, and hold it": "Ziehe am Faden, bis der Schnitt zu ist, und halte ihn",
  "Turn the needle about its circle, to the yellow mark": "Drehe die Nadel um ihren Kreis, zur gelben Marke", "Turn it on until the tip is out": "Drehe weiter, bis die Spitze heraus ist",
  "Draw the thread up until # cm are left, and take it # cm below the needle": "Ziehe den Faden hoch, bis noch # cm übrig sind, und nimm ihn # cm unter der Nadel",
  "Pull the needle off its thread": "Ziehe die Nadel von ihrem Faden ab",
  "Take the long tail": "Nimm das lange Ende", "Draw both tails apart until the slit is closed": "Ziehe beide Enden auseinander, bis der Schlitz zu ist",
  "Wind the long tail once around the other jaws, take the short tail with them, and draw it through":
    "Wickle das lange Ende einmal um die anderen Backen, nimm das kurze damit und ziehe es hindurch",
  "Wind the long tail twice around the other jaws, take the short tail with them, and draw it through":
    "Wickle das lange Ende zweimal um die anderen Backen, nimm das kurze damit und ziehe es hindurch",
  "Wind the long tail once around the other jaws, the other way round than before, take the short tail with them, and draw it through":
    "Wickle das lange Ende andersherum als zuvor einmal um die anderen Backen, nimm das kurze damit und ziehe es hindurch",
  "Draw both tails apart until the throw is tight": "Ziehe beide Enden auseinander, bis der Wurf fest ist",
  "This is another knot than was asked for: take the last throw out again": "Das ist ein anderer Knoten als verlangt: löse den letzten Wurf wieder",
  "The strands are let go of, and the slit is pulled apart": "Die Enden sind losgelassen, und der Schlitz wird auseinandergezogen",
  "Slack is left below the throw: lift the pusher a little, and push again": "Unter dem Wurf ist noch loser Faden: hebe den Schieber etwas an und schiebe erneut",
  "Push throw # of # down until the slit is closed": "Schiebe Wurf # von # hinunter, bis der Schlitz zu ist",
  "Take the pusher back up to the yellow mark": "Nimm den Schieber zurück bis zur gelben Marke",
  "Knot security": "Halt des Knotens",
  "Depth of the bite": "Tiefe des Stichs", "Gap of the cut": "Spalt des Schnitts", "Peak tension of the thread": "Größte Fadenspannung",
  "Tearing of holes": "Ausreißen der Stichkanäle", "Grasps of the needle": "Griffe an die Nadel", "Contact with rings": "Kontakt mit Ringen", "Peak force on rings": "Größte Kraft auf Ringe",
  "plan how the other hand is to take it before you hand it over": "plane vor dem Übergeben, wie die andere Hand sie nimmt", "turn the needle about its circle in place of pushing it": "drehe die Nadel um ihren Kreis, statt sie zu schieben",
  "Too much force: # N, expected at most # N": "Zu viel Kraft: # N, höchstens # N", "The shaft presses on the organ with # N": "Der Schaft drückt mit # N auf das Organ",
  "You press on what is around with # N": "Du drückst mit # N auf die Umgebung", "The tip is out of the picture": "Die Spitze ist nicht im Bild",
  "Peak force": "Größte Kraft", "Mean force in contact": "Mittlere Kraft im Kontakt", "Force-time product": "Kraft mal Zeit", "Force limit breaches": "Überschreitungen der Kraft",
  "Excess impulse": "Impuls über der Grenze", "Peak force rate": "Größter Kraftanstieg", "Peak grip": "Größter Griff", "Mean grip": "Mittlerer Griff", "Grip limit breaches": "Überschreitungen des Griffs",
  "Grip against pull": "Griff gegen Zug", "Shaft contact": "Kontakt des Schafts", "Peak force of the shaft": "Größte Kraft des Schafts", "Peak traction": "Größter Zug", "Peak tissue strain": "Größte Dehnung",
  "Time to completion": "Zeit", "Path length": "Weglänge", "Mean speed": "Mittleres Tempo", "Peak speed": "Größtes Tempo", "Peak speed in contact": "Größtes Tempo im Kontakt", "Path inefficiency": "Umweg",
  "Log dimensionless jerk": "Ruck (log)", "Angular path": "Drehweg", "Depth path": "Weg in die Tiefe", "Number of movements": "Zahl der Bewegungen", "Idle time": "Ruhezeit", "Idle share": "Anteil der Ruhe",
  "Out of view": "Nicht im Bild", "Off centre": "Nicht in der Mitte", "Horizon angle": "Neigung des Bilds", "Errors": "Fehler", "Grasp slips": "Abgerutscht", "Target error": "Abstand vom Ziel", "Share freed": "Befreiter Anteil", "Mean deviation": "Mittlere Abweichung",
  "Largest deviation": "Größte Abweichung", "Excess tissue": "Gewebe zu viel", "Jagged length": "Gezackte Länge", "Depth of the blade": "Tiefe der Klinge", "Time of current": "Dauer des Stroms",
  "Current without a target": "Strom ohne Ziel", "Tracing error (Frechet)": "Abweichung (Fréchet)", "Tracing error (RMS)": "Abweichung (RMS)", "RMS force in contact": "RMS-Kraft im Kontakt", "Peak contact pressure": "Größter Druck",
  "Peak force on surroundings": "Größte Kraft auf die Umgebung", "Economy of volume": "Sparsamkeit des Raums", "Smoothness (SPARC)": "Glätte (SPARC)", "Response orientation": "Ausrichtung", "Bimanual dexterity": "Geschick beider Hände",
  "approach slowly and stop at the first resistance": "nähere dich langsam und halte beim ersten Widerstand", "stay in light contact, less is enough": "bleib in leichtem Kontakt, weniger genügt",
  "watch the force bar, and ease off before it turns red": "sieh auf den Kraftbalken und lass nach, bevor er warnt", "ease off at once when the force bar turns red": "lass sofort nach, wenn der Kraftbalken warnt",
  "pull the thread until the edges meet, and hold it so": "ziehe am Faden, bis die Ränder sich treffen, und halte ihn so",
  "pull the thread slowly, and no harder than closes the cut": "ziehe langsam am Faden, und nur so fest, bis der Schnitt zu ist",
  "press and let go gradually": "drücke und löse allmählich", "close the jaws only until they hold": "schließe die Backen nur, bis sie halten",
  "keep the shaft away from the organ; look at more than the tip": "halte den Schaft vom Organ fern; sieh auf mehr als die Spitze", "plan the next movement during the present one": "plane die nächste Bewegung während der jetzigen",
  "go straight to the target": "geh gerade zum Ziel", "make one smooth movement in place of several corrections": "mach eine glatte Bewegung statt mehrerer Korrekturen", "turn the instrument less": "drehe das Instrument weniger",
  "be quicker where nothing is touched": "sei schneller, wo nichts berührt wird",
  "find the depth first, then go in once": "finde erst die Tiefe, dann geh einmal hinein", "make fewer, longer movements": "mach weniger, längere Bewegungen", "keep the tip in the picture": "halte die Spitze im Bild",
  "keep what is worked on in the middle of the picture": "halte, woran gearbeitet wird, in der Bildmitte", "turn the camera back whenever you roll the scope": "drehe die Kamera zurück, sooft du die Optik drehst",
  "touch only what is asked for": "berühre nur, was verlangt ist", "go around what is not yours to touch": "umgehe, was nicht berührt werden soll", "take more tissue between the jaws before you pull": "nimm mehr Gewebe zwischen die Backen, bevor du ziehst",
  "look at the target from where the light shows its place, then touch": "sieh das Ziel an, wo das Licht seinen Ort zeigt, dann berühre es", "slow down in the bends of the line": "fahre langsamer in den Bögen der Linie",
};
const ENGLISH = {
  "touch/": "Touch", "probe/": "Press and palpate", "trace/": "Follow a line", "grasp/": "Grasp and lift", "retract/": "Hold aside", "tease/": "Tease off",
  "dissect/": "Dissect", "cut/": "Cut", "bimanual/": "With two hands", "navigate/": "Hold the camera", "needle/": "Hand a needle over", "suture/": "Suture",
};
export const LANGUAGES = {en: ENGLISH, de: GERMAN};

const stored = name => {
  try {
    return localStorage.getItem(name);
  } catch {
    return null;  // a browser that keeps nothing
  }
};
let words = LANGUAGES[stored("palpate.language") ?? navigator.language.slice(0, 2)] ?? LANGUAGES.en;
export const language = () => Object.keys(LANGUAGES).find(name => LANGUAGES[name] === words);

// Returns a text in the page's language; {0}, {1} are the values.
export function t(text, ...values) {
  let found = words[text];
  if (found === undefined) {
    const numbers = text.match(NUMBER) ?? [];
    found = words[text.replace(NUMBER, "#")]?.replace(/#/g, () => numbers.shift()) ?? text;
  }
  return found.replace(/\{(\d)\}/g, (_, i) => values[i]);
}
const NUMBER = /\d+(\.\d+)?/g;

// What a domain and an exercise of it are called: "Suture", "Drive, easy".
const capital = text => text.charAt(0).toUpperCase() + text.slice(1);
export const domain = task => capital(t(`${task.split("/")[0]}/`).replace("/", ""));
export const level = task => capital(task.split("/")[1].split("_").map(word => t(word)).join(", "));
export const title = task => `${domain(task)}: ${level(task)}`;

// Puts the page itself into a language: texts, titles and labels that are marked as such.
export function speak(name = language()) {
  words = LANGUAGES[name] ?? LANGUAGES.en;
  document.documentElement.lang = language();
  try {
    localStorage.setItem("palpate.language", language());
  } catch { /* kept for this page alone */ }
  for (const element of document.querySelectorAll("[data-t]")) {
    const key = element.dataset.t ||= element.textContent.trim().replace(/\s+/g, " ");
    element.textContent = t(key);
  }
  for (const element of document.querySelectorAll("[data-label]")) element.setAttribute("aria-label", t(element.dataset.label));
}
