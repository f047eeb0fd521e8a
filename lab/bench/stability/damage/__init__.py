"""What each axis does to a scene. Damage gets in before the run or behind one stage of it.

Before: another configuration (`configuration.py`), raw files written anew into the case's folder (`raw_files.py`), or a
whole session simulated again (`simulated.py`). Behind a stage (`between.py`): what the stage left is read, damaged and
written over, so that all that follows works on it, and the stage's own health rows, made before, know nothing of it.
A function there is given what is to be damaged (`intact.py`) and says how; it raises `DoesNotApply` where its damage
means nothing for such a scene.
"""
