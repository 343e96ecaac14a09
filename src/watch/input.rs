//! Maps keys to actions.

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

/// An action of the user.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Quit.
    Quit,
    /// Pause the screen, or resume it.
    Pause,
    /// Move the selection of the signal down by the given number.
    Select(isize),
    /// Show the inputs in the place of the signals, or the signals again.
    Tune,
    /// Scroll the fields of the selected signal down by the given number.
    Scroll(isize),
}

/// Returns the action of a key, if it has one.
pub fn action(key: KeyEvent) -> Option<Action> {
    if key.kind == KeyEventKind::Release {
        return None;
    }
    match key.code {
        // In raw mode the terminal sends no signal for Ctrl-C.
        KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => Some(Action::Quit),
        KeyCode::Char('q') | KeyCode::Esc => Some(Action::Quit),
        KeyCode::Char(' ') => Some(Action::Pause),
        KeyCode::Char('t') => Some(Action::Tune),
        KeyCode::Down | KeyCode::Tab | KeyCode::Char('j') => Some(Action::Select(1)),
        KeyCode::Up | KeyCode::BackTab | KeyCode::Char('k') => Some(Action::Select(-1)),
        KeyCode::Right | KeyCode::PageDown => Some(Action::Scroll(1)),
        KeyCode::Left | KeyCode::PageUp => Some(Action::Scroll(-1)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_map_to_the_actions_that_the_screen_names() {
        let press = |code| action(KeyEvent::new(code, KeyModifiers::NONE));
        assert_eq!(press(KeyCode::Char('q')), Some(Action::Quit));
        assert_eq!(press(KeyCode::Char(' ')), Some(Action::Pause));
        assert_eq!(press(KeyCode::Char('t')), Some(Action::Tune));
        assert_eq!((press(KeyCode::Tab), press(KeyCode::Up)), (Some(Action::Select(1)), Some(Action::Select(-1))));
        assert_eq!((press(KeyCode::Char('c')), press(KeyCode::Char('x'))), (None, None));
        let interrupt = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
        assert_eq!(action(interrupt), Some(Action::Quit));
        assert_eq!(action(KeyEvent { kind: KeyEventKind::Release, ..interrupt }), None);
    }
}
